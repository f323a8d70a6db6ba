"""Written captures, in our own format read back the same; folders are complete or absent."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from viewmend.data.capture_folder import open_capture
from viewmend.data.errors import CaptureError
from viewmend.data.native_writer import atomic_folder, write_capture
from viewmend.data.source import CaptureSubset, CaptureWrapper


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


@pytest.mark.parametrize("kind", ["link", "working folder"])
def test_an_existing_folder_is_filled_and_not_replaced(tmp_path, monkeypatch, kind):
    folder = tmp_path / "empty"
    folder.mkdir()
    out = {"link": tmp_path / "link", "working folder": Path()}[kind]
    if kind == "link":
        out.symlink_to(folder)
    monkeypatch.chdir(folder)
    number = folder.stat().st_ino
    (folder / f".{out.absolute().name}.unfinished-{os.getpid()}").mkdir()  # left by a process of the same id
    with atomic_folder(out) as unfinished:
        unfinished.mkdir()
        for name in ("cameras.json", "image"):
            (unfinished / name).write_text(name)
        assert not (folder / "image").exists()
    assert sorted(path.name for path in folder.iterdir()) == ["cameras.json", "image"]
    assert folder.stat().st_ino == number and len(list(tmp_path.iterdir())) == 1 + (kind == "link")


def test_a_link_to_nothing_is_refused_at_once(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    with (
        pytest.raises(CaptureError, match="expected a new or empty folder"),
        atomic_folder(tmp_path / "link"),
    ):
        raise AssertionError("the work has begun")


def test_leftovers_of_a_process_with_the_same_id_are_removed(tmp_path):
    (tmp_path / f".copy.unfinished-{os.getpid()}").mkdir()
    with atomic_folder(tmp_path / "copy") as unfinished:
        unfinished.mkdir()
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_cameras_that_are_absent_from_all_written_frames_are_left_out(plain, tmp_path, caplog):
    plain.edit(lambda d: [camera.pop("mask") for camera in d["cameras"]])
    (plain.path / "images/d_000.png").unlink()
    write_capture(CaptureSubset(open_capture(plain.path), range(1)), tmp_path / "copy")
    assert open_capture(tmp_path / "copy").cameras.names == ("a", "b", "c")
    assert "cameras without an image in these frames are left out: d" in caplog.text


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
