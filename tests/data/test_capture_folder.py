"""Capture folders: units, gaps, padding, masks and depth, undistortion, and videos."""

import json
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
import torch
from reference.films import write_film

from viewmend.data.capture_folder import open_capture
from viewmend.data.errors import CaptureError
from viewmend.data.formats import read_any_calibration
from viewmend.data.undistortion import pixel_map
from viewmend.data.videos import VideoFile, VideoWriter


def rgb_of(plain, file):
    return torch.from_numpy(plain.get(file)[..., ::-1].copy()).permute(2, 0, 1)


def update(plain, view=None, **values):
    """Change keys of one camera, or of all."""
    cameras = plain.description["cameras"]
    for camera in cameras if view is None else [cameras[view]]:
        camera.update(values)
    plain.save()


def test_frames_are_read(plain):
    capture = open_capture(plain.path)
    assert (capture.name, capture.frame_ids, capture.fps) == ("ball", ("000", "001"), 25.0)
    assert capture.up.tolist() == [0, 1, 0]  # normalised
    assert capture.bounds.high.tolist() == [1, 1, 1] and capture.gaps == ()
    for time, frame_id in enumerate(capture.frame_ids):
        frame = capture.read(time)
        assert frame.time == time and frame.cameras.names == ("a", "b", "c", "d")
        for view, name in enumerate(frame.cameras.names):
            assert torch.equal(frame.rgb[view], rgb_of(plain, f"images/{name}_{frame_id}.png"))
            assert torch.equal(frame.mask[view], torch.from_numpy(plain.get(f"masks/{name}_{frame_id}.png")))
    for time in (-1, 2):
        with pytest.raises(IndexError, match=f"0 to 1, got {time}"):
            capture.read(time)


def test_files_of_captures_and_folders_of_users_are_understood(plain, monkeypatch):
    with pytest.raises(CaptureError, match=r"got the file .*\.png; open its folder, .*images"):
        open_capture(sorted((plain.path / "images").iterdir())[0])
    monkeypatch.setenv("HOME", str(plain.path.parent))
    assert len(open_capture(f"~/{plain.path.name}").cameras) == 4


def test_cameras_can_be_selected(plain):
    assert open_capture(plain.path / "cameras.json", ["c", "a"]).read(1).cameras.names == ("c", "a")
    with pytest.raises(CaptureError, match=r"among \['a', 'b', 'c', 'd'\], each once, got \['e'\]"):
        open_capture(plain.path, ["e"])
    with pytest.raises(CaptureError, match="each once"):
        open_capture(plain.path, ["a", "a"])
    with pytest.raises(ValueError, match="expected cameras as a list of names, got the string 'ca'"):
        open_capture(plain.path, "ca")


@pytest.mark.parametrize("metres_per_unit", [0.001, 1.0])
def test_units_become_metres(plain, metres_per_unit):
    truth = open_capture(plain.path)

    def rescale(description):
        description["metres_per_unit"] = metres_per_unit
        description["bounds"] = [[x / metres_per_unit for x in corner] for corner in description["bounds"]]
        for camera in description["cameras"]:
            camera["t"] = [x / metres_per_unit for x in camera["t"]]

    capture = open_capture(plain.edit(rescale).path)
    torch.testing.assert_close(capture.cameras.camera_from_world, truth.cameras.camera_from_world)
    torch.testing.assert_close(capture.bounds.low, truth.bounds.low)
    assert capture.metres_per_unit == metres_per_unit


@pytest.mark.parametrize(
    ("first", "shift"),
    [([0.5, 0.5], (0, 0)), ([0, 0], (0.5, 0.5)), ([1, 0], (-0.5, 0.5)), (None, (0.5, 0.5))],
)
def test_pixel_centres_become_one_half(plain, first, shift):
    truth = torch.tensor([camera["K"] for camera in plain.description["cameras"]])
    K = open_capture(plain.edit(lambda d: d.update(first_pixel_center=first)).path).cameras.K
    torch.testing.assert_close(K[:, :2, 2] - truth[:, :2, 2], torch.tensor(shift).expand(4, 2).float())
    torch.testing.assert_close(K[:, :, :2], truth[:, :, :2])


def test_rounded_rotations_become_exact(plain):
    for camera in plain.description["cameras"]:
        camera["R"] = np.round(camera["R"], 4).tolist()
    plain.save()
    R = open_capture(plain.path).cameras.camera_from_world[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(4, 3, 3), atol=1e-6, rtol=0)


def test_smaller_images_are_padded_right_and_below(plain):
    small = np.full((20, 30, 3), 77, np.uint8)
    plain.put("images/b_000.png", small)
    plain.put("masks/b_000.png", np.full((20, 30), 255, np.uint8))
    update(plain, 1, width=30, height=20, image="images/b_000.png", mask="masks/b_000.png")
    frame = open_capture(plain.path).read(0)
    assert frame.cameras.size_px.tolist() == [[40, 32], [30, 20], [40, 32], [40, 32]]
    assert frame.rgb.shape == (4, 3, 32, 40)
    assert (frame.rgb[1, :, :20, :30] == 77).all() and (frame.mask[1, :20, :30] == 255).all()
    assert (
        not frame.rgb[1, :, 20:].any() and not frame.rgb[1, :, :, 30:].any() and not frame.mask[1, 20:].any()
    )
    alone = frame.select(["b"])
    assert alone.rgb.shape == (1, 3, 20, 30) and alone.mask.shape == (1, 20, 30)


def test_a_missing_image_is_a_gap(plain):
    (plain.path / "images/b_001.png").unlink()
    (plain.path / "masks/d_000.png").unlink()
    capture = open_capture(plain.path)
    assert capture.gaps == (("b", "001"), ("d", "000")) and capture.cameras.names == ("a", "b", "c", "d")
    assert capture.read(0).cameras.names == ("a", "b", "c")
    frame = capture.read(1)
    assert frame.cameras.names == ("a", "c", "d")
    assert torch.equal(frame.rgb[2], rgb_of(plain, "images/d_001.png"))


def test_masks_of_all_kinds_are_equal(plain):
    soft = cv2.GaussianBlur(plain.get("masks/a_000.png"), (3, 3), 0)
    opaque = np.full_like(soft, 255)
    images = {
        "grey.png": soft,
        "colour.png": np.dstack([soft] * 3),
        "one_channel.png": np.dstack([soft * 0, soft * 0, soft]),
        "opaque.png": np.dstack([soft, soft, soft, opaque]),
        "alpha.png": np.dstack([opaque // 3] * 3 + [soft]),
    }
    for file, image in images.items():
        plain.put(f"masks/{file}", image)
        update(plain, 0, mask=f"masks/{file}")
        assert torch.equal(open_capture(plain.path).read(0).mask[0], torch.from_numpy(soft)), file


def test_alpha_keeps_its_levels_where_masks_in_files_are_labels(plain):
    soft = cv2.GaussianBlur(plain.get("masks/a_000.png"), (5, 5), 0)
    plain.put("images/alpha.png", np.dstack([plain.get("images/a_000.png"), soft]))
    update(plain, image="images/alpha.png", mask_labels=True)
    capture = open_capture(plain.path, masks="alpha")
    assert torch.equal(capture.read(0).mask[0], torch.from_numpy(soft))


def test_no_alpha_is_read_outside_of_the_folder(plain):
    cv2.imwrite(str(plain.path.parent / "outside.png"), plain.get("images/a_000.png"))
    plain.edit(lambda content: content.update(frames=["../../outside"]))
    update(plain, image="images/{frame}.png")
    with pytest.raises(CaptureError, match="expected a file inside the folder"):
        open_capture(plain.path, masks="alpha")


def test_jpeg_masks_and_exif_rotation(plain):
    mask = plain.get("masks/a_000.png")
    plain.put("masks/a.jpg", mask)
    update(plain, 0, mask="masks/a.jpg")
    read = open_capture(plain.path).read(0).mask[0]
    assert ((read > 127) == torch.from_numpy(mask > 127)).float().mean() > 0.98
    # The orientation 6, a quarter turn, must not turn an image that the calibration was made for.
    data = cv2.imencode(".jpg", np.full((32, 40, 3), 90, np.uint8))[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    head = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif
    (plain.path / "images/a.jpg").write_bytes(head + data[2:])
    update(plain, 0, image="images/a.jpg")
    assert (open_capture(plain.path).read(0).rgb[0] == 90).all()


def test_depth_is_in_millimetres(plain):
    depth = np.arange(32 * 40, dtype=np.uint16).reshape(32, 40) * 40
    plain.put("depth/a.png", depth)
    update(plain, depth="depth/a.png")
    read = open_capture(plain.path).read(0).depth
    torch.testing.assert_close(read[2], torch.from_numpy(depth.astype(np.float32)) / 1000)


def test_masks_are_optional(plain):
    capture = open_capture(plain.edit(lambda d: [camera.pop("mask") for camera in d["cameras"]]).path)
    assert not capture.has_masks and capture.read(0).mask is None


def test_null_is_absent_and_unknown_keys_are_ignored(plain):
    nothing = {"up": None, "fps": None, "bounds": None, "metres_per_unit": None, "recorded": "in the rain"}
    plain.edit(lambda d: d.update(nothing))
    (plain.path / "cameras.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(plain.description).encode())
    capture = open_capture(plain.path)
    assert (capture.up, capture.fps, capture.bounds, capture.metres_per_unit) == (None, None, None, 1.0)


# Undistortion.

BARREL, PINCUSHION = [-0.5, 0.1, 0.02, -0.01, -0.02], [0.5, 0.1, -0.02, 0.01, 0.1]


def waves(x, y):
    return np.uint8(128 + 60 * np.sin(9 * x) + 60 * np.sin(11 * y + 1))


def distort(K, dist):
    """An image of `waves` by a camera with this lens."""
    v, u = np.mgrid[:32, :40].astype(np.float64)
    x, y = (u + 0.5 - K[0, 2]) / K[0, 0], (v + 0.5 - K[1, 2]) / K[1, 1]
    x_u, y_u = x, y
    for _ in range(100):  # invert the forward model by fixed-point iteration
        r2 = x_u**2 + y_u**2
        radial = 1 + dist[0] * r2 + dist[1] * r2**2 + dist[4] * r2**3
        dx = 2 * dist[2] * x_u * y_u + dist[3] * (r2 + 2 * x_u**2)
        dy = dist[2] * (r2 + 2 * y_u**2) + 2 * dist[3] * x_u * y_u
        x_u, y_u = (x - dx) / radial, (y - dy) / radial
    return waves(x_u, y_u)


@pytest.mark.parametrize("dist", [BARREL, PINCUSHION])
@pytest.mark.parametrize("first", [0.5, 0.0])
def test_images_and_masks_are_undistorted(plain, dist, first):
    K = np.array(plain.description["cameras"][0]["K"])
    image = distort(K, dist)
    plain.put("images/lens.png", np.dstack([image] * 3))
    plain.put("masks/lens.png", image)
    shifted = (K - [[0, 0, 0.5 - first], [0, 0, 0.5 - first], [0, 0, 0]]).tolist()
    plain.edit(lambda d: d.update(first_pixel_center=[first, first]))
    update(plain, 0, dist=dist, image="images/lens.png", mask="masks/lens.png", K=shifted)
    frame = open_capture(plain.path).read(0)
    truth = torch.from_numpy(distort(K, [0.0] * 5)).float()
    inside = slice(4, -4), slice(4, -4)  # a pincushion lens does not see the corners
    assert (frame.rgb[0].float() - truth)[:, *inside].abs().mean() < 0.6
    assert (frame.mask[0].float() - truth)[inside].abs().mean() < 0.6
    assert (torch.from_numpy(image).float() - truth)[inside].abs().mean() > 3  # the distortion matters


def test_pixels_outside_the_distorted_image_repeat_its_border(plain):
    K = np.array(plain.description["cameras"][0]["K"])
    plain.put("masks/lens.png", np.full((32, 40), 255, np.uint8))
    plain.put("depth/lens.png", np.full((32, 40), 2000, np.uint16))
    update(plain, 0, dist=[1.5, 0, 0, 0, 0], mask="masks/lens.png")
    update(plain, depth="depth/lens.png")
    frame = open_capture(plain.path).read(0)
    assert (frame.mask[0] == 255).all()  # unknown there, so it must not carve the hull
    assert frame.depth[0, 0, 0] == 0 and abs(float(frame.depth[0, 16, 20]) - 2) < 1e-6
    assert float(frame.cameras.K[0, 0, 0]) == pytest.approx(K[0, 0])


def test_depths_are_not_interpolated(plain):
    depth = np.full((32, 40), 1000, np.uint16)
    depth[:, 21:] = 3000
    plain.put("depth/edge.png", depth)
    update(plain, depth="depth/edge.png", dist=BARREL)
    assert set(open_capture(plain.path).read(0).depth[0].unique().tolist()) <= {0.0, 1.0, 3.0}


@pytest.mark.parametrize("dist", [[1e-9, 0, 0, 0, 0], [-0.2, 0.1, 0.02, -0.01, -0.02], [-1.2, 0, 0, 0, 0]])
def test_pixels_are_where_a_lens_distorts_their_rays_to(plain, dist):
    """Against OpenCV's distortion of points; the last lens model does not describe the image's corners."""
    K = np.array(plain.description["cameras"][0]["K"])
    update(plain, 0, dist=dist)
    found = pixel_map(read_any_calibration(plain.path).cameras[0])
    v, u = np.mgrid[:32, :40] + 0.5
    rays = np.linalg.inv(K) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
    no_pose, no_camera = np.zeros(3), np.eye(3)
    seen = cv2.projectPoints(rays.T, no_pose, no_pose, no_camera, np.array(dist, float))[0][:, 0]
    expected = (K @ np.hstack([seen, np.ones((len(seen), 1))]).T)[:2].T.reshape(32, 40, 2) - 0.5
    steps = np.stack([found.fractions % 32, found.fractions // 32], -1)
    inside = ((expected > 0) & (expected < [39, 31])).all(-1)
    assert (found.beyond is not None) == (dist[0] < -1)
    if found.beyond is not None:
        assert 0 < found.beyond.sum() < 100
        inside &= ~found.beyond
    assert inside.sum() > 800
    assert abs(found.positions + steps / 32 - expected)[inside].max() < 0.51 / 32


def test_beyond_what_a_lens_model_describes_the_last_pixels_are_repeated(plain):
    """With k1 = -0.4 alone and a wide view, the image would begin again, mirrored, where r^2 = 1 / (3 * 0.4)."""
    K = [[14.0, 0, 20], [0, 14, 16], [0, 0, 1]]
    stripes = np.tile(np.arange(40, dtype=np.uint8) * 6, (32, 1))
    plain.put("images/lens.png", np.dstack([stripes] * 3))
    plain.put("depth/lens.png", np.full((32, 40), 2000, np.uint16))
    update(plain, 0, dist=[-0.4, 0, 0, 0, 0], image="images/lens.png", K=K)
    update(plain, depth="depth/lens.png")
    frame = open_capture(plain.path).read(0)
    row = frame.rgb[0, 0, 16].int()
    assert (row.diff() >= 0).all() and row[33] == row[39] < 6 * 30
    assert frame.depth[0, 16, 39] == 0 and abs(float(frame.depth[0, 16, 30]) - 2) < 1e-6


# Videos.

GREYS = [20 * index for index in range(12)]


@pytest.fixture
def video(plain):
    plain.put_video("grey.avi", [np.full((32, 40, 3), grey, np.uint8) for grey in GREYS])
    return VideoFile(plain.path / "grey.avi")


def grey_at(video, index):
    return round(float(video.read(index, "here").mean()))


def test_a_video_is_thread_safe_and_survives_reading_past_its_end(video):
    with ThreadPoolExecutor(8) as pool:
        greys = list(pool.map(lambda index: grey_at(video, index), [*range(12), *range(12)]))
    assert greys == pytest.approx([*GREYS, *GREYS], abs=2)
    with pytest.raises(CaptureError, match="here: expected at least 13 frames in the video, got 12"):
        video.read(12, "here")
    assert grey_at(video, 3) == pytest.approx(GREYS[3], abs=2)


def test_images_and_masks_may_be_videos(plain):
    red, white = np.zeros((32, 40, 3), np.uint8), np.zeros((32, 40, 3), np.uint8)
    red[..., 2] = 255  # OpenCV writes BGR
    white[8:24, 8:24] = 255
    plain.put_video("red.avi", [red, red])
    plain.put_video("mask.avi", [white, 255 - white])
    update(plain, 0, video="red.avi", mask="mask.avi", image=None)
    capture = open_capture(plain.path)
    frame = capture.read(1)
    assert (frame.rgb[0, 0] > 240).all() and (frame.rgb[0, 1:] < 15).all()
    expected = torch.ones(32, 40, dtype=torch.bool)
    expected[8:24, 8:24] = False
    assert torch.equal(frame.mask[0] > 127, expected) and torch.equal(
        capture.read(0).mask[0] > 127, ~expected
    )


def test_frames_that_are_not_listed_are_those_of_the_footage(plain):
    """As of the calibration that a board gives, which is copied next to any footage."""
    del plain.description["frames"]
    plain.save()
    assert open_capture(plain.path).frame_ids == ("000", "001")
    update(plain, image="missing/{frame}.png")
    with pytest.raises(
        CaptureError, match=r"expected 'frames', or images with a number for \{frame\} in missing/"
    ):
        open_capture(plain.path)
    for view, name in enumerate("abcd"):
        update(plain, view, image=f"{name}/{{frame}}.png", mask=None)
        for frame in range(3 + (view == 1)):
            plain.put(f"{name}/{frame:04d}.png", np.zeros((32, 40, 3), np.uint8))
        plain.put(f"{name}/{9:04d}_mask.png", np.zeros((32, 40), np.uint8))
    capture = open_capture(plain.path)
    assert capture.frame_ids == ("0000", "0001", "0002", "0003") and capture.present.sum() == 13
    for view, name in enumerate("abcd"):
        plain.put_video(f"{name}.avi", [np.zeros((32, 40, 3), np.uint8)] * (5 + view))
        update(plain, view, video=f"{name}.avi", image=None)
    assert len(open_capture(plain.path).frame_ids) == 5, "videos end with the shortest"
    (plain.path / "a.avi").unlink()
    with pytest.raises(
        CaptureError, match=r"expected the cameras' videos, as no 'frames' are listed, got no a\.avi"
    ):
        open_capture(plain.path)
    assert len(open_capture(plain.path, cameras=["b", "c"]).frame_ids) == 6


@pytest.mark.parametrize(("stated", "expected"), [(None, 25), (25.1, 25.1), (30, 25)])
def test_the_rate_is_that_of_the_videos(plain, stated, expected):
    for view, name in enumerate("abcd"):
        plain.put_video(f"{name}.avi", [np.zeros((32, 40, 3), np.uint8)] * 4)
        update(plain, view, video=f"{name}.avi", image=None, mask=None)
    plain.description |= {"fps": stated, "frames": [f"{n:03d}" for n in range(4)]}
    plain.save()
    assert open_capture(plain.path).fps == pytest.approx(expected)


def test_a_stated_rate_holds_for_videos_without_times(plain):
    frames = [np.zeros((32, 40, 3), np.uint8)] * 6
    for view, name in enumerate("abcd"):
        write_film(plain.path / f"{name}.h264", frames, fps=30)
        update(plain, view, video=f"{name}.h264", image=None, mask=None)
    plain.description |= {"fps": 60, "frames": [f"{n:03d}" for n in range(6)]}
    plain.save()
    assert open_capture(plain.path).fps == 60


def test_written_videos_keep_size_and_colour(tmp_path):
    rgb = np.zeros((33, 41, 3), np.uint8)
    rgb[:, :20] = (200, 30, 60)
    with VideoWriter(tmp_path / "new" / "clip.mp4", 25.0) as writer:
        for _ in range(3):
            writer.add(rgb)
    read = VideoFile(tmp_path / "new" / "clip.mp4").read(2, "here")
    assert read.shape == (32, 40, 3)
    assert np.abs(read[5:25, 2:16].astype(int) - (200, 30, 60)).max() < 12
    assert read[:, 26:].max() < 12


def test_a_frame_without_a_subject_has_empty_masks(plain):
    """What a compressed video leaves in them is no subject."""
    for name in "abcd":
        plain.put(f"masks/{name}_001.png", np.tile(np.arange(40, dtype=np.uint8), (32, 1)))
    capture = open_capture(plain.path)
    assert [capture.read(time).has_subject for time in (0, 1)] == [True, False]
    assert not capture.read(1).mask.any() and capture.read(1).rgb.any()
