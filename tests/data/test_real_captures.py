"""The four real captures that developers keep beside the repository: their units, masks, lenses and videos."""

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from viewmend.data.native_capture import NativeCapture, open_capture
from viewmend.data.source import prefetch
from viewmend.geometry.cameras import project
from viewmend.geometry.proxy import GeometryProxy, reconstruct
from viewmend.types import MultiViewFrame


def silhouette_iou(frame: MultiViewFrame, proxy: GeometryProxy) -> Tensor:
    covered, foreground = proxy.depth(frame.cameras) > 0, frame.mask > 127
    return (covered & foreground).sum((1, 2)) / (covered | foreground).sum((1, 2))


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
    iou = silhouette_iou(frame, proxy)
    assert iou.mean() > mean and iou.min() > lowest, iou
    up = torch.tensor([0.0, 1.0, 0.0]) if capture.up is None else capture.up
    along = proxy.mesh.vertices @ up
    assert height_m[0] < float(along.max() - along.min()) < height_m[1]  # metres, whatever the folder's unit


def test_the_lens_of_utrecht_matters(shared):
    """Without its distortion, the same masks agree less: so undistortion goes the right way."""
    capture = open_capture(shared / "captures" / "utrecht")
    straight = capture.read(0)
    bent = torch.stack(
        [
            torch.from_numpy(
                cv2.imread(str(shared / f"captures/utrecht/masks_derived/cam{c}_000.png"), cv2.IMREAD_GRAYSCALE)
            )
            for c in (1, 2, 3, 4)
        ]
    )
    moved = MultiViewFrame(straight.cameras, straight.rgb, bent, 0)
    scores = [
        float(silhouette_iou(f, reconstruct(f.mask, f.cameras, capture.bounds)).mean()) for f in (straight, moved)
    ]
    assert scores[0] > scores[1] + 0.015, scores


def test_utrecht_is_a_stream(shared):
    capture = open_capture(shared / "captures" / "utrecht")
    assert (len(capture.frame_ids), capture.fps, capture.gaps) == (426, 50.0, ())
    frames = list(prefetch(capture, [0, 40, 41]))
    assert [frame.time for frame in frames] == [0, 40, 41]
    near, far = ((frames[i].rgb.float() - frames[1].rgb.float()).abs().mean() for i in (2, 0))
    assert 0 < near < far  # videos advance


def teal_cap(frame: MultiViewFrame, view: int) -> Tensor | None:
    """Where the swimmer's cap is: the middle of the largest teal blob in the upper half."""
    width, height = frame.cameras.size_px[view].tolist()
    rgb = frame.rgb[view, :, : height // 2, :width].permute(1, 2, 0).contiguous().numpy()
    hue, saturation, value = np.moveaxis(cv2.cvtColor(rgb, cv2.COLOR_RGB2HSV), -1, 0)
    teal = (hue > 85) & (hue < 102) & (saturation > 130) & (value > 70)
    count, _, stats, centres = cv2.connectedComponentsWithStats(teal.astype(np.uint8))
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()) if count > 1 else 0
    return torch.from_numpy(centres[largest] + 0.5).float() if largest and stats[largest, -1] > 300 else None


def test_the_rays_of_pose2sim_meet(shared):
    """No masks here: the swimmer's cap, found by colour in four portrait videos, triangulates."""
    capture: NativeCapture = open_capture(shared / "captures" / "pose2sim")
    assert not capture.has_masks and capture.fps == 60
    for time in (0, 30):
        frame = capture.read(time)
        assert frame.mask is None and frame.rgb.shape == (4, 3, 1920, 1088)
        pixels = torch.stack([cap for view in range(4) if (cap := teal_cap(frame, view)) is not None])
        assert len(pixels) == 4
        P = frame.cameras.K @ frame.cameras.camera_from_world[:, :3]
        rows = torch.cat([pixels[:, :1, None] * P[:, 2:] - P[:, :1], pixels[:, 1:, None] * P[:, 2:] - P[:, 1:2]])[:, 0]
        point = torch.linalg.lstsq(rows[:, :3], -rows[:, 3:]).solution[:, 0]
        uv, _ = project(point[None], frame.cameras)
        assert (uv[:, 0] - pixels).norm(dim=-1).median() < 20, (uv[:, 0], pixels)
        assert 1.2 < float(point[2]) < 2.4  # metres above the treadmill
