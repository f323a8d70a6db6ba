"""Written captures, in our own format read back the same; folders are complete or absent."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from viewmend.data.capture_folder import open_capture
from viewmend.data.errors import CaptureError
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
        torch.testing.assert_close(
            a.cameras.camera_from_world, b.cameras.camera_from_world, atol=1e-6, rtol=0
        )
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
    write_capture(
        Changed(open_capture(plain.path), lambda frame: replace(frame, depth=depth)), tmp_path / "copy"
    )
    for time in (0, 1):
        assert (open_capture(tmp_path / "copy").read(time).depth - depth).abs().max() < 0.5001e-3
    far = Changed(open_capture(plain.path), lambda frame: replace(frame, depth=torch.full(depth.shape, 70.0)))
    with pytest.raises(CaptureError, match=r"0 to 65\.535 m, got 70"):
        write_capture(far, tmp_path / "far")


def test_rotations_are_written_exactly(plain, tmp_path):
    write_capture(open_capture(plain.path), tmp_path / "copy")
    for camera in json.loads((tmp_path / "copy/cameras.json").read_text())["cameras"]:
        R = np.array(camera["R"])
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


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
    assert sorted(p.name for p in (tmp_path / "copy" / "image").iterdir()) == [
        "camera00",
        "camera01",
        "camera02",
        "ok",
    ]
