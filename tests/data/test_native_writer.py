"""Written captures, in our own format and for RIFTCast, read back the same; folders are complete or absent."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from reference.ball import BallCapture, ring
from reference.foreign_studios import write_easyvolcap
from reference.random_rigs import named, random_rig

from viewmend.cli import main
from viewmend.data.errors import CaptureError
from viewmend.data.native_capture import open_capture
from viewmend.data.native_writer import write_capture
from viewmend.data.source import CaptureWrapper


class Changed(CaptureWrapper):
    """A source whose frames are changed by a function."""

    def __init__(self, source, change):
        self.source, self.change = source, change

    def read(self, time):
        return self.change(self.source.read(time))


def assert_same(written, source, tolerance=0):
    assert written.frame_ids == source.frame_ids and written.fps == source.fps
    torch.testing.assert_close(written.up, source.up)
    torch.testing.assert_close(written.bounds.low, source.bounds.low)
    for time in range(len(source.frame_ids)):
        a, b = written.read(time), source.read(time)
        assert a.cameras.names == b.cameras.names
        torch.testing.assert_close(a.cameras.K, b.cameras.K)
        torch.testing.assert_close(a.cameras.camera_from_world, b.cameras.camera_from_world, atol=1e-6, rtol=0)
        assert torch.equal(a.cameras.size_px, b.cameras.size_px)
        assert torch.equal(a.mask, b.mask)
        assert (a.rgb.float() - b.rgb.float()).abs().mean() <= tolerance


def test_png_captures_round_trip_exactly(plain, tmp_path):
    plain.edit(lambda d: d["cameras"][2].update(dist=[-0.2, 0.1, 0, 0, 0]))  # undistorted once, not twice
    plain.edit(lambda d: d["cameras"][1].update(width=30, height=20))
    for kind in ("images", "masks"):
        for frame in ("000", "001"):
            plain.put(f"{kind}/b_{frame}.png", plain.get(f"{kind}/b_{frame}.png")[:20, :30])
    (plain.path / "images/d_001.png").unlink()
    source = open_capture(plain.path)
    write_capture(source, tmp_path / "copy", images="png")
    assert_same(open_capture(tmp_path / "copy"), source)
    description = json.loads((tmp_path / "copy" / "cameras.json").read_text())
    assert description["format"] == "plain-capture/1" and description["first_pixel_center"] == [0.5, 0.5]
    assert description["cameras"][0]["image"] == "image/a/{frame}.png"


def test_jpeg_loses_little(plain, tmp_path):
    smooth = torch.linspace(0, 255, 40).expand(4, 3, 32, 40).byte()
    source = Changed(open_capture(plain.path), lambda frame: replace(frame, rgb=smooth.clone()))
    write_capture(source, tmp_path / "copy", images="jpeg")
    assert_same(open_capture(tmp_path / "copy"), source, tolerance=2)


def test_depth_is_kept_to_half_a_millimetre(plain, tmp_path, rng):
    depth = 3 * torch.rand((4, 32, 40), generator=rng)
    write_capture(Changed(open_capture(plain.path), lambda frame: replace(frame, depth=depth)), tmp_path / "copy")
    for time in (0, 1):
        assert (open_capture(tmp_path / "copy").read(time).depth - depth).abs().max() < 0.5001e-3
    far = Changed(open_capture(plain.path), lambda frame: replace(frame, depth=torch.full(depth.shape, 70.0)))
    with pytest.raises(CaptureError, match=r"0 to 65\.535 m, got 70"):
        write_capture(far, tmp_path / "far")


def test_folders_in_use_are_not_changed(plain, tmp_path):
    out = tmp_path / "mine"
    out.mkdir()
    (out / "thesis.txt").write_text("precious")
    with pytest.raises(CaptureError, match=r"mine: expected a new or empty folder"):
        write_capture(open_capture(plain.path), out)
    assert [p.name for p in out.iterdir()] == ["thesis.txt"]
    (out / "thesis.txt").unlink()
    write_capture(open_capture(plain.path), out)
    assert open_capture(out).frame_ids == ("000", "001")


def test_failures_leave_nothing_behind(plain, tmp_path):
    (plain.path / "images/c_001.png").write_bytes(b"")
    seen = []
    with pytest.raises(CaptureError, match=r"c_001\.png"):
        write_capture(
            open_capture(plain.path), tmp_path / "copy", progress=lambda ts: (seen.append(t) or t for t in ts)
        )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ball"] and seen == [0, 1]


def test_camera_names_may_be_invalid_file_names(plain, tmp_path):
    names = ["Camera (1)", "../up", "a/b", "ok"]
    plain.edit(lambda d: [camera.update(name=name) for camera, name in zip(d["cameras"], names, strict=True)])
    source = open_capture(plain.path)
    write_capture(source, tmp_path / "copy", images="png")
    assert_same(open_capture(tmp_path / "copy"), source)
    assert sorted(p.name for p in (tmp_path / "copy" / "image").iterdir()) == ["camera00", "camera01", "camera02", "ok"]


# RIFTCast data sets.


@pytest.fixture
def ball(tmp_path):
    write_capture(BallCapture(ring(4)), tmp_path / "plain", images="png")
    file = tmp_path / "plain/cameras.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"up": [0.0, 0.6, 0.8]}))
    assert main(["convert", str(tmp_path / "plain"), str(tmp_path / "out"), "--to", "riftcast"]) == 0
    return tmp_path


def test_captures_convert_to_riftcast_and_back(ball):
    before = open_capture(ball / "plain")
    for path in (ball / "out", ball / "out/dataset.json"):
        after = open_capture(path)
        assert after.cameras.names == tuple(str(n) for n in range(4))
        torch.testing.assert_close(after.cameras.K, before.cameras.K)
        torch.testing.assert_close(after.cameras.camera_from_world, before.cameras.camera_from_world)
        one, other = before.read(0), after.read(0)
        assert torch.equal(one.mask > 127, other.mask == 255)
        assert (one.rgb.float() - other.rgb.float()).abs().mean() < 2  # JPEG
        torch.testing.assert_close(after.up, before.up, atol=1e-6, rtol=0)


def test_riftcasts_frame_has_y_up_and_its_cube_contains_the_subject(ball):
    """Uses the program's own formula V_gl = D V_file D to_world."""
    meta = json.loads((ball / "out/dataset.json").read_text())
    stored = json.loads((ball / "out/calibration.json").read_text())["cameras"][1]
    D = np.diag([1.0, -1, -1, 1])
    to_world = np.array(meta["dataset"]["to_world"]).reshape(4, 4)
    view = D @ np.array(stored["extrinsics"]["view_matrix"]).reshape(4, 4) @ D @ to_world
    capture, point = open_capture(ball / "plain"), np.array([0.1, 0.7, -0.2, 1.0])
    K, pose = (x[1].double().numpy() for x in (capture.cameras.K, capture.cameras.camera_from_world))
    np.testing.assert_allclose(view @ point, D @ pose @ [*(D @ to_world @ point)[:3], 1.0], atol=1e-5)
    np.testing.assert_allclose((D @ to_world)[:3, 1], capture.up, atol=1e-6)
    center, half = np.array(meta["volume"]["position"]), meta["volume"]["scale"]
    uv = K @ (pose @ [*(D @ to_world)[:3, :3] @ center, 1])[:3]
    assert 0.01 < half < 10 and int(capture.read(0).mask[1, int(uv[1] / uv[2]), int(uv[0] / uv[2])]) == 255


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("gaps", "expected all cameras, got 2 of 3"),
        ("sizes", "expected images of one size"),
        ("no masks", "expected masks, which RIFTCast needs"),
    ],
)
def test_captures_that_riftcast_cannot_have_are_rejected(tmp_path, capsys, fault, message):
    rig = named([c | {"width": 20, "height": 16} for c in random_rig(3, 3)], "{:02d}")
    gaps = {(rig[0]["name"], "000001")} if fault == "gaps" else ()
    rig[0]["width"] = 24 if fault == "sizes" else 20
    write_easyvolcap(tmp_path / "take", rig, ["000000", "000001"], gaps)
    if fault == "no masks":
        shutil.rmtree(tmp_path / "take/masks")
    assert main(["convert", str(tmp_path / "take"), str(tmp_path / "out"), "--to", "riftcast"]) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
