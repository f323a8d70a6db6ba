import json

import cv2
import numpy as np
import pytest
import torch

from viewmend.capture.errors import CaptureError
from viewmend.capture.plain import open_capture
from viewmend.geometry.proxy import reconstruct


def rgb_of(plain, file):
    return torch.from_numpy(plain.get(file)[..., ::-1].copy()).permute(2, 0, 1)


def test_reads_what_is_there(plain):
    capture = open_capture(plain.path)
    assert (capture.name, capture.frame_ids, capture.fps) == ("ball", ("000", "001"), 25.0)
    assert capture.up.tolist() == [0, 1, 0]  # made a unit vector
    assert capture.bounds.high.tolist() == [1, 1, 1]
    assert capture.gaps == ()
    for time, frame_id in enumerate(capture.frame_ids):
        frame = capture.read(time)
        assert frame.time == time
        assert frame.cameras.names == ("a", "b", "c", "d")
        for view, name in enumerate(frame.cameras.names):
            assert torch.equal(frame.rgb[view], rgb_of(plain, f"images/{name}_{frame_id}.png"))
            assert torch.equal(frame.mask[view], torch.from_numpy(plain.get(f"masks/{name}_{frame_id}.png")))


def test_the_hull_of_the_ball_fills_the_masks(plain):
    frame = open_capture(plain.path).read(0)
    covered = reconstruct(frame.mask, frame.cameras).depth(frame.cameras) > 0
    foreground = frame.mask > 127
    assert float((covered & foreground).sum() / (covered | foreground).sum()) > 0.8


def test_the_calibration_file_opens_as_its_folder_does(plain):
    assert open_capture(plain.path / "cameras.json").name == "ball"


def test_cameras_can_be_chosen(plain):
    assert open_capture(plain.path, ["c", "a"]).read(1).cameras.names == ("c", "a")
    with pytest.raises(CaptureError, match=r"among \['a', 'b', 'c', 'd'\], got \['e'\]"):
        open_capture(plain.path, ["e"])
    with pytest.raises(CaptureError, match="different cameras"):
        open_capture(plain.path, ["a", "a"])


@pytest.mark.parametrize("metres_per_unit", [0.001, 0.1, 1.0])
def test_units_become_metres(plain, metres_per_unit):
    truth = open_capture(plain.path)

    def in_units(description):
        description["metres_per_unit"] = metres_per_unit
        description["bounds"] = [[x / metres_per_unit for x in corner] for corner in description["bounds"]]
        for camera in description["cameras"]:
            camera["t"] = [x / metres_per_unit for x in camera["t"]]

    capture = open_capture(plain.edit(in_units).path)
    torch.testing.assert_close(capture.cameras.camera_from_world, truth.cameras.camera_from_world)
    torch.testing.assert_close(capture.bounds.low, truth.bounds.low)
    assert capture.metres_per_unit == metres_per_unit


@pytest.mark.parametrize(
    ("first", "shift"), [([0.5, 0.5], (0, 0)), ([0, 0], (0.5, 0.5)), ([1, 0], (-0.5, 0.5)), (None, (0.5, 0.5))]
)
def test_k_moves_to_pixel_centres_at_one_half(plain, first, shift):
    truth = torch.tensor([camera["K"] for camera in plain.description["cameras"]])
    K = open_capture(plain.edit(lambda d: d.update(first_pixel_center=first)).path).cameras.K
    torch.testing.assert_close(K[:, :2, 2] - truth[:, :2, 2], torch.tensor(shift).expand(4, 2).float())
    torch.testing.assert_close(K[:, :, :2], truth[:, :, :2])


def test_a_rotation_of_few_digits_is_made_exact(plain):
    def few_digits(description):
        for camera in description["cameras"]:
            camera["R"] = np.round(camera["R"], 4).tolist()

    pose = open_capture(plain.edit(few_digits).path).cameras.camera_from_world[:, :3, :3]
    torch.testing.assert_close(pose @ pose.mT, torch.eye(3).expand(4, 3, 3), atol=1e-6, rtol=0)


def test_smaller_images_are_padded_right_and_below(plain):
    small = np.full((20, 30, 3), 77, np.uint8)
    plain.put("images/b_000.png", small)
    plain.put("masks/b_000.png", small[..., 0])
    plain.edit(lambda d: d["cameras"][1].update(width=30, height=20, image="images/b_000.png", mask="masks/b_000.png"))
    frame = open_capture(plain.path).read(0)
    assert frame.cameras.size_px.tolist() == [[40, 32], [30, 20], [40, 32], [40, 32]]
    assert frame.rgb.shape == (4, 3, 32, 40)
    assert (frame.rgb[1, :, :20, :30] == 77).all() and (frame.mask[1, :20, :30] == 77).all()
    assert not frame.rgb[1, :, 20:].any() and not frame.rgb[1, :, :, 30:].any() and not frame.mask[1, 20:].any()
    alone = frame.select(["b"])
    assert alone.rgb.shape == (1, 3, 20, 30) and alone.mask.shape == (1, 20, 30)


def test_a_gap_is_a_camera_less(plain):
    (plain.path / "images/b_001.png").unlink()
    (plain.path / "masks/d_000.png").unlink()
    capture = open_capture(plain.path)
    assert capture.gaps == (("b", "001"), ("d", "000"))
    assert capture.cameras.names == ("a", "b", "c", "d")
    assert capture.read(0).cameras.names == ("a", "b", "c")
    frame = capture.read(1)
    assert frame.cameras.names == ("a", "c", "d")
    assert torch.equal(frame.rgb[2], rgb_of(plain, "images/d_001.png"))


def test_times_outside_the_capture(plain):
    for time in (-1, 2):
        with pytest.raises(IndexError, match=f"0 to 1, got {time}"):
            open_capture(plain.path).read(time)


def test_masks_of_every_type_mean_the_same(plain):
    mask = plain.get("masks/a_000.png")
    soft = cv2.GaussianBlur(mask, (3, 3), 0)
    opaque = np.full_like(soft, 255)
    kinds = {
        "grey.png": soft,
        "colour.png": np.dstack([soft] * 3),
        "one_channel_used.png": np.dstack([soft * 0, soft * 0, soft]),
        "opaque.png": np.dstack([soft, soft, soft, opaque]),
        "cut_out.png": np.dstack([opaque // 3] * 3 + [soft]),
    }
    for file, image in kinds.items():
        plain.put(f"masks/{file}", image)
        plain.edit(lambda d, file=file: d["cameras"][0].update(mask=f"masks/{file}"))
        assert torch.equal(open_capture(plain.path).read(0).mask[0], torch.from_numpy(soft)), file


def test_jpeg_masks_and_pictures_turned_by_exif(plain):
    mask = plain.get("masks/a_000.png")
    plain.put("masks/a.jpg", mask)
    plain.edit(lambda d: d["cameras"][0].update(mask="masks/a.jpg"))
    read = open_capture(plain.path).read(0).mask[0]
    assert ((read > 127) == torch.from_numpy(mask > 127)).float().mean() > 0.98
    # An orientation tag (6: a quarter turn) must not turn what the calibration was made of.
    data = cv2.imencode(".jpg", np.full((32, 40, 3), 90, np.uint8))[1].tobytes()
    tiff = b"MM\x00*\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00\x00\x00\x00\x00"
    exif = b"Exif\x00\x00" + tiff
    (plain.path / "images/a.jpg").write_bytes(
        data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    )
    plain.edit(lambda d: d["cameras"][0].update(image="images/a.jpg"))
    assert (open_capture(plain.path).read(0).rgb[0] == 90).all()


def test_depth_in_millimetres(plain):
    depth = np.arange(32 * 40, dtype=np.uint16).reshape(32, 40) * 40
    plain.put("depth/a.png", depth)
    plain.edit(lambda d: [camera.update(depth="depth/a.png") for camera in d["cameras"]])
    read = open_capture(plain.path).read(0).depth
    torch.testing.assert_close(read[2], torch.from_numpy(depth.astype(np.float32)) / 1000)


def test_a_capture_without_masks(plain):
    plain.edit(lambda d: [camera.pop("mask") for camera in d["cameras"]])
    capture = open_capture(plain.path)
    assert not capture.has_masks
    assert capture.read(0).mask is None


def test_null_is_absent_and_notes_pass(plain):
    nothing = {"up": None, "fps": None, "bounds": None, "metres_per_unit": None, "recorded": "in the rain"}
    capture = open_capture(plain.edit(lambda d: d.update(nothing)).path)
    assert (capture.up, capture.fps, capture.bounds, capture.metres_per_unit) == (None, None, None, 1.0)


def test_a_byte_order_mark_is_no_matter(plain):
    (plain.path / "cameras.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(plain.description).encode())
    assert open_capture(plain.path).frame_ids == ("000", "001")
