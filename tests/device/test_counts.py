"""The pipeline on a device that is not the CPU: it mixes no tensors, gives the same images, and asks little of it.

The ceilings count kernels, waits for the device and copies to it, and are only ever lowered.
"""

from pathlib import Path

import pytest
import torch
from reference.other_device import COUNTS, other_device

import viewmend
from viewmend.models.checkpoint import load_inpainter
from viewmend.models.network import set_compute_dtype
from viewmend.models.registry import make_method
from viewmend.stream import Stream
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.utils import timing

SIZE_PX = 96
FIRST = orbit([0.4], (SIZE_PX, SIZE_PX), elevation_rad=0.25)
NEXT = orbit([0.5], (SIZE_PX, SIZE_PX), elevation_rad=0.25)
CEILINGS = {
    "telea": (222, 6, 7),
    "rays": (450, 7, 17),
    "views": (900, 8, 37),
    "paper-small": (540, 6, 17),
}
"""Kernels, waits and copies of a second view of a frame, close to the first."""
MIN_PSNR_DB = 100.0
"""A shipped network's image on the device has at least this PSNR against the CPU's. The two rasterisers may give a
pixel of an edge to different triangles."""


def inpainter_of(name):
    """A model that computes in float32, as on the CPU without bfloat16."""
    if name == "telea":
        return make_method(name)
    model = load_inpainter(name)
    set_compute_dtype(model, torch.float32)
    return model


def psnr_db(image, expected):
    return float(-10 * (image - expected).square().mean().clamp(min=1e-12).log10())


@pytest.mark.parametrize("name", CEILINGS)
def test_a_view_is_the_same_and_asks_little_of_the_device(name, monkeypatch):
    studio = Studio(StudioConfig(seed=10011, cameras=6, frames=1, size_px=SIZE_PX))
    frame = studio.read(0)
    inpainter = inpainter_of(name)
    on_cpu = Stream(inpainter, bounds=studio.bounds)
    on_cpu.add_frame(frame)
    expected = [on_cpu.view(target).completed.rgb for target in (FIRST, NEXT)]
    with other_device(monkeypatch) as device:
        if isinstance(inpainter, torch.nn.Module):
            inpainter.to(device)
        stream = Stream(inpainter, bounds=studio.bounds)
        stream.add_frame(frame.to(device))
        first = stream.view(FIRST.to(device)).completed.rgb.cpu()
        target = NEXT.to(device)
        COUNTS.reset()
        completed = stream.view(target).completed
        asked = (COUNTS.kernels, COUNTS.waits, COUNTS.copies)
        second = completed.rgb.cpu()
        mended = stream.mend(stream.render(target)).completed.rgb.cpu()
    assert all(own <= most for own, most in zip(asked, CEILINGS[name], strict=True)), f"{name}: {asked}"
    assert min(psnr_db(first, expected[0]), psnr_db(second, expected[1])) >= MIN_PSNR_DB
    assert mended.shape == second.shape and bool(mended.isfinite().all())


@pytest.mark.slow
@pytest.mark.parametrize("bounds", [True, False])
def test_the_hull_of_48_cameras_asks_little_of_the_device(bounds, monkeypatch):
    studio = Studio(StudioConfig(seed=10011, cameras=48, frames=1, size_px=SIZE_PX))
    frame = studio.read(0)
    box = studio.bounds if bounds else None
    expected = Stream(make_method("telea"), bounds=box).add_frame(frame).proxy.mesh
    with other_device(monkeypatch) as device:
        there = frame.to(device)
        COUNTS.reset()
        mesh = Stream(make_method("telea"), bounds=box).add_frame(there).proxy.mesh
        asked = (COUNTS.kernels, COUNTS.waits, COUNTS.copies)
        vertices = mesh.vertices.cpu()
    most = (545, 10, 16) if bounds else (680, 14, 20)
    assert all(own <= ceiling for own, ceiling in zip(asked, most, strict=True)), asked
    assert mesh.faces.shape == expected.faces.shape and (vertices - expected.vertices).abs().max() < 1e-3


def test_a_device_is_waited_for_only_where_times_are_exact(monkeypatch):
    waited = []
    monkeypatch.setattr(torch.cuda, "synchronize", waited.append)
    device = torch.device("cuda")
    timing.ms_since(timing.now_s(device), device)
    assert not waited
    with timing.exact_times():
        timing.ms_since(timing.now_s(device), device)
    assert waited == [device, device]
    timing.now_s(device)
    assert len(waited) == 2


def test_no_other_code_waits_for_a_device():
    package = Path(viewmend.__file__).parent
    waiting = [file for file in package.rglob("*.py") if "synchronize(" in file.read_text()]
    assert waiting == [Path(timing.__file__)]
