"""Processing only the part of a view that shows the subject gives the same result."""

import pytest
import torch

from viewmend.live.poses import home_view, view_camera
from viewmend.live.protocol import Camera
from viewmend.models.base import Inpainter, RenderQuality
from viewmend.models.checkpoint import load_inpainter
from viewmend.rendering import crop
from viewmend.rendering.crop import Crop, mesh_crop, subject_crop
from viewmend.rendering.view import render_view
from viewmend.stream import Stream
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import CompletedView


@pytest.fixture(scope="module")
def scene():
    studio = Studio(StudioConfig(seed=7, cameras=6, frames=2, size_px=96))
    stream = Stream(load_inpainter("rays"), bounds=studio.bounds)
    for time in range(2):
        observation = stream.add_frame(studio.read(time))
    return (
        stream,
        home_view(studio.cameras, observation.proxy.mesh.vertices.mean(0), studio.up),
        observation.proxy,
    )


@pytest.mark.parametrize("context_times", [0, 1, None])
@pytest.mark.parametrize(("azimuth", "distance"), [(20.0, 1.0), (75.0, 1.0), (140.0, 0.6)])
def test_a_crop_gives_the_same_image_as_the_whole_view(scene, azimuth, distance, context_times, monkeypatch):
    stream, frame, proxy = scene
    asked = Camera(azimuth=frame.azimuth + azimuth, elevation=8.0, distance=distance * frame.distance_m)
    camera = view_camera(asked, frame, (420, 330))
    quality = RenderQuality(context_times=context_times)
    part = stream.view(camera, quality=quality).completed
    filled = subject_crop(part.view, stream.inpainter.crop_margin_px(quality))
    whole_image = Crop.all_of(camera)
    assert mesh_crop(proxy.mesh.vertices, camera) != whole_image and (filled != whole_image or distance < 1)
    observation = stream.cached_frame()
    whole_view, _ = render_view(observation.frame, proxy, camera, stream.config.render)
    monkeypatch.setattr(stream.inpainter, "crop_margin_px", lambda quality: None)
    whole = stream.mend(whole_view, quality=quality).completed
    assert bool((whole.view.error > 0).any())
    # Edges of triangles may fall on the other side of a pixel's centre, by rounding.
    assert int(((whole.view.mask != part.view.mask) | (whole.view.error != part.view.error)).sum()) <= 2
    off = (whole.rgb - part.rgb).abs().amax(0)
    assert float(off.mean()) < 1e-5
    assert (
        float((off > 1 / 255).float().mean()) < 3e-4
    )  # holes so deep that a smooth fill is coarser than the grid
    assert part.view.camera is camera
    assert whole.view.weights.shape == part.view.weights.shape


def test_crops_lie_within_the_view(scene):
    _, frame, proxy = scene
    away = view_camera(Camera(azimuth=0.0, target=(5.0, 0.0, 0.0)), frame, (64, 48))
    found = mesh_crop(proxy.mesh.vertices, away)
    assert found.left < found.right <= 64 and found.top < found.bottom <= 48
    to_the_left = view_camera(Camera(azimuth=0.0, target=(-5.0, 0.0, 0.0)), frame, (64, 48))
    assert min(found.right - found.left, mesh_crop(proxy.mesh.vertices, to_the_left).right) == 1, (
        "at least one pixel"
    )
    near = view_camera(Camera(distance=0.05), frame, (64, 48))
    assert mesh_crop(proxy.mesh.vertices, near) == Crop.all_of(near), (
        "a part of the subject is behind the camera"
    )
    assert mesh_crop(torch.zeros(0, 3), away) == Crop.all_of(away)


def test_crops_are_on_the_grid_and_have_their_margin(scene):
    stream, frame, _ = scene
    view = stream.render(view_camera(Camera(azimuth=frame.azimuth), frame, (700, 500)))
    found = subject_crop(view, 30)
    assert found != Crop.all_of(view.camera)
    sides = found.left, found.top, found.right, found.bottom
    assert all(side % crop.grid_px(30) == 0 or side in (500, 700) for side in sides)
    rows, columns = torch.nonzero(view.mask > 0).unbind(1)
    assert found.left <= int(columns.min()) - 30 and int(columns.max()) + 30 < found.right
    assert found.top <= max(0, int(rows.min()) - 30) and min(499, int(rows.max()) + 30) < found.bottom
    part = found.of_view(view)
    again = found.uncropped(part, view.camera)
    for name in ("rgb", "mask", "error", "depth", "weights"):
        assert torch.equal(getattr(again, name), getattr(view, name))


def test_alpha_confidence_and_depth_are_pasted_into_the_whole_view(scene):
    """Outside the crop there is no subject, and colours stay as rendered."""
    stream, frame, _ = scene

    class PredictsAll(Inpainter):
        def crop_margin_px(self, quality):
            return 4

        def step(self, view, context, state):
            rgb = torch.where(view.error > 0, 0.5, view.rgb)
            return CompletedView(view, rgb, 0.5 * view.mask, view.mask, 2 * view.depth), state

    camera = view_camera(Camera(azimuth=30.0, elevation=8.0, distance=frame.distance_m), frame, (420, 330))
    telling = Stream(PredictsAll(), stream.config)
    telling.add_frame(stream.cached_frame().frame, stream.cached_frame().proxy)
    for completed in (telling.view(camera).completed, telling.mend(telling.render(camera)).completed):
        assert completed.rgb.shape == (3, 330, 420)
        assert torch.equal(completed.alpha, 0.5 * completed.view.mask)
        assert torch.equal(completed.confidence, completed.view.mask)
        assert torch.equal(completed.depth, 2 * completed.view.depth)
        assert bool((completed.rgb[:, completed.view.error > 0] == 0.5).all())
