"""Real captures that developers keep next to the repository: their units, masks, lenses and videos."""

import pytest
import torch

from viewmend.data.capture_folder import open_capture
from viewmend.data.source import prefetch
from viewmend.geometry.proxy import reconstruct


@pytest.mark.parametrize(
    ("name", "cameras", "mean", "lowest", "height_m"),
    [
        ("wd2", 20, 0.945, 0.925, (1.4, 1.8)),
        ("utrecht", 4, 0.94, 0.88, (1.0, 2.0)),
        ("dino", 16, 0.96, 0.87, (0.07, 0.1)),
    ],
)
def test_calibration_masks_and_lenses_agree(shared, name, cameras, mean, lowest, height_m):
    capture = open_capture(shared / "captures" / name)
    frame = capture.read(0)
    assert len(capture.cameras) == len(frame.cameras) == cameras
    proxy = reconstruct(frame.mask, frame.cameras, capture.bounds)
    covered, foreground = proxy.depth(frame.cameras) > 0, frame.mask > 127
    iou = (covered & foreground).sum((1, 2)) / (covered | foreground).sum((1, 2))
    assert iou.mean() > mean and iou.min() > lowest, iou
    up = torch.tensor([0.0, 1.0, 0.0]) if capture.up is None else capture.up
    along = proxy.mesh.vertices @ up
    assert height_m[0] < float(along.max() - along.min()) < height_m[1]  # metres, whatever the folder's unit


def test_utrecht_is_a_stream(shared):
    capture = open_capture(shared / "captures" / "utrecht")
    assert (len(capture.frame_ids), capture.fps, capture.gaps) == (426, 50.0, ())
    frames = list(prefetch(capture, [0, 40, 41]))
    assert [frame.time for frame in frames] == [0, 40, 41]
    near, far = ((frames[i].rgb.float() - frames[1].rgb.float()).abs().mean() for i in (2, 0))
    assert 0 < near < far  # videos advance
