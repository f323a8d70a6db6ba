"""Writing any source of frames with masks as a data set of RIFTCast (VCI)."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from viewmend.capture.errors import CaptureError
from viewmend.capture.formats.riftcast import CALIBRATION, FLIP
from viewmend.capture.images import write_image
from viewmend.capture.plain_writer import whole_folder
from viewmend.capture.prefetch import prefetch
from viewmend.capture.run_lengths import RUN_LENGTHS, run_lengths
from viewmend.capture.source import CaptureSource
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.proxy import reconstruct
from viewmend.views import MultiViewFrame

META = "dataset.json"
MARGIN = 1.2
"""How much larger the cube is than the first frame's hull, where the source has no bounds."""


def write_riftcast(
    source: CaptureSource, out: Path, *, progress: Callable[[Iterable[int]], Iterable[int]] | None = None
) -> None:
    """Write JPEG images, masks as run lengths, `calibration.json`, and `dataset.json`, which RIFTCast is started with.

    Cameras are numbered in their order. The program's frame has y up where the source knows up, and its cube holds the
    source's bounds, or the first frame's hull. `out` is complete or absent.

    Raises:
        CaptureError: `out` is in use; RIFTCast cannot have such a source: images of different sizes, gaps, no masks.
    """
    sizes = sorted({tuple(size) for size in source.cameras.size_px.tolist()})
    if len(sizes) > 1:
        raise CaptureError(f"{source.name}: expected images of one size, got {sizes}; choose cameras of one size")
    times = range(len(source.frame_ids))
    bounds = source.bounds
    with whole_folder(out) as folder:
        for number, frame in enumerate(prefetch(source, times if progress is None else progress(times))):
            _write_frame(source, frame, folder / f"frame_{number:05d}")
            if bounds is None:
                bounds = _around(frame)
        _write_json(folder / CALIBRATION, {"cameras": _cameras(source)})
        _write_json(folder / META, _meta(source, bounds, Path(out).resolve()))


def _write_frame(source: CaptureSource, frame: MultiViewFrame, folder: Path) -> None:
    where = f"{source.name}: frame '{source.frame_ids[frame.time]}'"
    if frame.mask is None:
        raise CaptureError(f"{where}: expected masks, without which RIFTCast has no hull, got none; make them first")
    if len(frame.cameras) < len(source.cameras):
        got = f"{len(frame.cameras)} of {len(source.cameras)}"
        raise CaptureError(f"{where}: expected all cameras, got {got}; leave out the frame or the cameras")
    for view in range(len(frame.cameras)):
        write_image(folder / f"rgb/rgb_{view}.jpeg", frame.rgb[view].permute(1, 2, 0).contiguous().cpu().numpy())
        file = folder / f"mask/mask_{view}{RUN_LENGTHS}"
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(run_lengths(frame.mask[view].cpu().numpy()))


def _around(frame: MultiViewFrame) -> Bounds | None:
    assert frame.mask is not None
    vertices = reconstruct(frame.mask, frame.cameras, None).mesh.vertices
    if not len(vertices):
        return None
    low, high = vertices.amin(0), vertices.amax(0)
    grow = (MARGIN - 1) / 2 * (high - low)
    return Bounds(low - grow, high + grow)


def _cameras(source: CaptureSource) -> list[dict[str, Any]]:
    cameras = source.cameras.to("cpu")
    return [
        {
            "camera_id": view,
            "camera_model_name": name,
            "extrinsics": {"view_matrix": cameras.camera_from_world[view].flatten().tolist()},
            "intrinsics": {
                "camera_matrix": cameras.K[view].flatten().tolist(),
                "resolution": cameras.size_px[view].tolist(),
            },
        }
        for view, name in enumerate(cameras.names)
    ]


def _meta(source: CaptureSource, bounds: Bounds | None, path: Path) -> dict[str, Any]:
    turn = _turn_up(source)
    dataset = {"frame_count": len(source.frame_ids), "start_frame": 0, "path": str(path), "camera_path": CALIBRATION}
    to_world = np.eye(4)
    to_world[:3, :3] = FLIP[:3, :3] @ turn  # stored = FLIP @ to_world @ program
    dataset |= {"flip_images": True, "flip_masks": True, "to_world": to_world.ravel().tolist()}
    meta = {"type": "VCI", "version": "2.0.0", "dataset": dataset, "reconstructor": {"partial_masks": True}}
    if bounds is not None:
        ends = torch.stack([bounds.low, bounds.high]).double().cpu().numpy()
        corners = (
            np.array([[ends[i, 0], ends[j, 1], ends[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) @ turn
        )
        low, high = corners.min(0), corners.max(0)
        meta["volume"] = {"position": ((low + high) / 2).tolist(), "scale": float((high - low).max() / 2)}
    return meta


def _turn_up(source: CaptureSource) -> np.ndarray:
    """A rotation from a frame whose y is up to the source's; the identity where it does not know up."""
    if source.up is None:
        return np.eye(3)
    up = source.up.double().cpu().numpy()
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    return np.stack([side, up, np.cross(side, up)], 1)


def _write_json(file: Path, value: dict[str, Any]) -> None:
    file.write_text(json.dumps(value, indent=1), encoding="utf-8")
