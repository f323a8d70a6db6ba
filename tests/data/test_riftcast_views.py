"""An export as RIFTCast writes it, by its own arithmetic, comes back as the views that it was made of."""

import json

import cv2
import numpy as np
import pytest
import torch

from viewmend import CaptureError, Stream, make_method
from viewmend.data.formats.riftcast import write_riftcast
from viewmend.data.holdout.riftcast_views import RiftcastViews
from viewmend.data.native_capture import open_capture
from viewmend.data.synthetic.stage import Studio, StudioConfig

SIZE = 96
HELD = "1"


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A data set, its export, and our own views that the export was made of."""
    folder = tmp_path_factory.mktemp("riftcast")
    write_riftcast(Studio(StudioConfig(seed=10004, cameras=6, frames=2, size_px=SIZE)), folder / "data")
    meta = json.loads((folder / "data/dataset.json").read_text())
    angle = np.cos(0.3), np.sin(0.3)
    turned = np.array([[angle[0], 0, angle[1], 0.2], [0, 1, 0, -0.1], [-angle[1], 0, angle[0], 0.3], [0, 0, 0, 1]])
    meta["dataset"]["to_world"] = turned.flatten().tolist()
    (folder / "data/dataset.json").write_text(json.dumps(meta))
    capture = open_capture(folder / "data")
    stream, views = Stream(make_method("telea")), {}
    for time in range(2):
        seen = stream.add_frame(capture.read(time))
        proxy = seen.proxy
        out = folder / f"export/frame_{time:05d}"
        for kind in ("rgb", "mask", "error", "depth"):
            (out / kind).mkdir(parents=True)
        program_from_stored = np.linalg.inv(np.diag([1.0, -1, -1, 1]) @ turned)
        vertices = proxy.mesh.vertices.double().numpy() @ program_from_stored[:3, :3].T + program_from_stored[:3, 3]
        vertices.astype("<f4").tofile(out / "vertices.bin")
        proxy.mesh.faces.numpy().astype("<i8").tofile(out / "faces.bin")
        for name in capture.cameras.names:
            view = stream.view(capture.cameras.select([name]), time=time).completed.view
            views[time, name] = view
            white = view.rgb * 0.999 + (view.mask <= 0) + (view.error > 0)
            bgr = (white.clamp(0, 1) * 255).round().byte().movedim(0, -1).numpy()[..., ::-1]
            cv2.imwrite(str(out / f"rgb/rgb_{name}.png"), bgr)
            cv2.imwrite(str(out / f"mask/mask_{name}.png"), (view.mask > 0).numpy().astype("u1") * 255)
            cv2.imwrite(str(out / f"error/error_{name}.png"), (view.error > 0).numpy().astype("u1") * 255)
            z, n, f = view.depth.double().numpy(), 0.01, 1000.0
            clip = (f + n) / (f - n) * z - 2 * f * n / (f - n)  # -z in front of a camera of OpenGL
            window = np.where(z > 0, (clip / np.where(z > 0, z, 1) + 1) / 2, 1.0)
            window[::-1].astype("<f4").tofile(out / f"depth/depth_{name}.bin")
    chosen = np.tile(np.array([0, 2, 4], "<i4"), (2, 6, 1))
    chosen[1, 1] = [1, 3, 5]
    chosen.tofile(folder / "export/used_cameras.bin")
    return folder, views


def test_views_come_back_as_they_were_rendered(exported):
    folder, views = exported
    read = RiftcastViews(folder / "export", folder / "data/dataset.json")
    for (time, name), view in views.items():
        back = read.view(time, name)
        assert torch.equal(back.mask > 0, view.mask > 0) and torch.equal(back.error > 0, view.error > 0)
        right = (view.mask > 0) & (view.error == 0)
        assert (back.rgb - view.rgb).abs()[:, right].max() < 0.01
        assert back.rgb[:, ~right].max() == 0  # neither the white background nor a white hole
        # A 24-bit window of 1000 m says 3 m to within a few centimetres.
        torch.testing.assert_close(back.depth, view.depth, atol=0.08, rtol=0)
        assert (back.depth - view.depth)[right].mean().abs() < 0.01
        assert torch.equal(back.holes, back.error > 0)


def test_who_coloured_a_view_is_not_the_camera_that_it_stands_for(exported):
    folder, _ = exported
    read = RiftcastViews(folder / "export", folder / "data")
    assert read.view(0, HELD).source_views == ("0", "2", "4")
    assert read.view(1, HELD).source_views == ("3", "5")
    assert read.view(0, "0").source_views == ("2", "4")
    view = read.view(0, HELD)
    assert HELD not in view.candidate_views and len(view.candidate_views) == 5
    assert view.candidate_views[0] in ("0", "2")
    assert view.silhouettes is not None and HELD not in view.silhouettes.cameras.names
    weight = view.weights.sum(0)
    assert set(weight.unique().tolist()) <= {0.0, 1.0}


def test_geometry_is_where_the_cameras_see_it(exported):
    folder, views = exported
    read = RiftcastViews(folder / "export", folder / "data")
    for (time, name), view in views.items():
        depth = read.geometry(time).depth(read.capture.cameras.select([name]))[0]
        both = (depth > 0) & (view.depth > 0)
        assert both.sum() > 0.98 * (view.depth > 0).sum()
        assert (depth - view.depth)[both].abs().median() < 1e-3


def test_a_stream_mends_the_views_without_the_camera(exported):
    folder, _ = exported
    read = RiftcastViews(folder / "export", folder / "data")
    stream = Stream(make_method("telea"))
    stream.add_frame(read.capture.read(0).without([HELD]), read.geometry(0))
    view = read.view(0, HELD)
    completed = stream.mend(view).completed
    missing = view.error > 0
    assert missing.any() and completed.rgb[:, missing].mean() > 0.02
    assert torch.equal(completed.rgb[:, ~missing], view.rgb[:, ~missing])


def test_what_is_no_export_is_refused(exported, tmp_path):
    folder, _ = exported
    with pytest.raises(CaptureError, match="expected an export"):
        RiftcastViews(tmp_path, folder / "data")
    (tmp_path / "frame_00000/error").mkdir(parents=True)
    (tmp_path / "used_cameras.bin").write_bytes(np.full(18, 9, "<i4").tobytes())
    with pytest.raises(CaptureError, match="numbers of 6 cameras"):
        RiftcastViews(tmp_path, folder / "data")
    (tmp_path / "used_cameras.bin").unlink()
    read = RiftcastViews(tmp_path, folder / "data")
    with pytest.raises(CaptureError, match=r"rgb_1\.png"):
        read.view(0, HELD)
    (tmp_path / "frame_00000/vertices.bin").write_bytes(bytes(13))
    with pytest.raises(CaptureError, match="13 bytes"):
        read.geometry(0)
    (tmp_path / "frame_00000/vertices.bin").write_bytes(bytes(12))
    (tmp_path / "frame_00000/faces.bin").write_bytes(np.array([0, 1, 2], "<i8").tobytes())
    with pytest.raises(CaptureError, match="among 1 vertices"):
        read.geometry(0)
