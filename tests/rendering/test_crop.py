"""Working on the subject's part of a view alone changes nothing but the time it takes."""

import pytest
import torch
from inpainting.plates import Rig, tiny, view

from viewmend.inpainting.checkpoint import load_inpainter
from viewmend.inpainting.protocol import RenderQuality, State
from viewmend.live.poses import rig_frame, view_camera
from viewmend.live.protocol import Camera
from viewmend.rendering import crop
from viewmend.rendering.crop import Crop, mesh_crop, subject_crop
from viewmend.rendering.view import render_view
from viewmend.stream import Stream
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.views import CompletedView


@pytest.fixture(scope="module")
def scene():
    studio = Studio(StudioConfig(seed=7, cameras=6, frames=2, size_px=96))
    stream = Stream(load_inpainter("small"), bounds=studio.bounds)
    for time in range(2):
        observation = stream.push(studio.read(time))
    return stream, rig_frame(studio.cameras, observation.proxy.mesh.vertices.mean(0), studio.up), observation.proxy


@pytest.mark.parametrize("context_times", [0, 1, None])
@pytest.mark.parametrize(("azimuth", "distance"), [(20.0, 1.0), (75.0, 1.0), (140.0, 0.6)])
def test_the_same_picture_as_of_the_whole_view(scene, azimuth, distance, context_times, monkeypatch):
    stream, frame, proxy = scene
    asked = Camera(azimuth=frame.azimuth + azimuth, elevation=8.0, distance=distance * frame.distance_m)
    camera = view_camera(asked, frame, (420, 330))
    quality = RenderQuality(context_times=context_times)
    part = stream.view(camera, quality=quality).completed
    filled = subject_crop(part.view, stream.inpainter.crop_margin_px(quality))
    assert mesh_crop(proxy.mesh.vertices, camera) is not None and (filled is not None or distance < 1)
    observation = stream.observation()
    whole_view = render_view(observation.frame, proxy, camera, stream.config.render)
    monkeypatch.setattr(stream.inpainter, "crop_margin_px", lambda quality: None)
    whole = stream.mend(whole_view, quality=quality).completed
    assert bool((whole.view.error > 0).any())
    # Edges of triangles may fall on the other side of a pixel's centre, by rounding.
    assert int(((whole.view.mask != part.view.mask) | (whole.view.error != part.view.error)).sum()) <= 2
    off = (whole.rgb - part.rgb).abs().amax(0)
    assert float(off.mean()) < 1e-5
    assert float((off > 1 / 255).float().mean()) < 3e-4  # holes so deep that a smooth fill is coarser than the grid
    assert part.view.camera is camera
    assert whole.view.weights.shape == part.view.weights.shape


def test_the_margin_is_what_patches_look_around_themselves(monkeypatch):
    """The encoder tells the black within a view from what is beyond it."""
    monkeypatch.setattr(crop, "grid_px", lambda margin_px: 16)
    net, size = tiny(coarse_fill="none"), {"width": 420, "height": 360}
    incomplete = view(0, (150, 200, 180, 240), **size)
    whole, _ = net.step(incomplete, Rig(**size), net.initial_state())
    errors = []
    for margin_px in (net.crop_margin_px(RenderQuality()), 2):
        found = subject_crop(incomplete, margin_px)
        part, _ = net.step(found.of_view(incomplete), Rig(**size), net.initial_state())
        errors.append(float((part.rgb - found.of_image(whole.rgb)).abs().max()))
    assert errors[0] < 2e-5 < errors[1]


def test_a_view_without_holes_shown_keeps_its_identity(scene):
    stream, frame, _ = scene
    camera = view_camera(Camera(azimuth=frame.azimuth), frame, (200, 160))
    part = stream.view(camera, quality=RenderQuality(mend=False)).completed
    assert part.rgb is part.view.rgb


def test_crops_lie_within_the_view(scene):
    _, frame, proxy = scene
    away = view_camera(Camera(azimuth=0.0, target=(5.0, 0.0, 0.0)), frame, (64, 48))
    found = mesh_crop(proxy.mesh.vertices, away)
    assert found is None or (found.left < found.right <= 64 and found.top < found.bottom <= 48)
    near = view_camera(Camera(distance=0.05), frame, (64, 48))
    assert mesh_crop(proxy.mesh.vertices, near) is None  # some of the subject is behind
    assert mesh_crop(torch.zeros(0, 3), away) is None


def test_what_is_filled_lies_on_the_grid_and_has_its_margin(scene):
    stream, frame, _ = scene
    view = stream.render(view_camera(Camera(azimuth=frame.azimuth), frame, (700, 500)))
    found = subject_crop(view, 30)
    assert found is not None
    assert all(
        side % crop.grid_px(30) == 0 or side in (500, 700)
        for side in (found.left, found.top, found.right, found.bottom)
    )
    rows, columns = torch.nonzero(view.mask > 0).unbind(1)
    assert found.left <= int(columns.min()) - 30 and int(columns.max()) + 30 < found.right
    assert found.top <= max(0, int(rows.min()) - 30) and min(499, int(rows.max()) + 30) < found.bottom
    part = found.of_view(view)
    again = found.uncropped(part, view.camera)
    for name in ("rgb", "mask", "error", "depth", "weights"):
        assert torch.equal(getattr(again, name), getattr(view, name))


@pytest.mark.parametrize(
    ("margin_px", "expected"), [(1, 16), (8, 16), (16, 16), (17, 32), (57, 64), (64, 64), (65, 128)]
)
def test_the_grid_is_the_first_power_of_two_that_holds_the_margin(margin_px, expected):
    assert crop.grid_px(margin_px) == expected


def test_a_crops_camera_sees_the_same_rays(scene):
    _, frame, _ = scene
    camera = view_camera(Camera(), frame, (64, 48))
    seen = Crop(16, 0, 40, 30).of_camera(camera)
    assert seen.max_size_px == (24, 30)
    assert float(seen.K[0, 0, 2]) == pytest.approx(float(camera.K[0, 0, 2]) - 16)


def test_what_an_inpainter_tells_beside_colours_comes_back_in_the_whole_view(scene):
    """Around the part that was completed there is no subject, and colours stay as they were rendered."""
    stream, frame, _ = scene

    class Tells:
        def initial_state(self):
            return State()

        def crop_margin_px(self, quality):
            return 4

        def step(self, view, context, state):
            rgb = torch.where(view.error > 0, 0.5, view.rgb)
            return CompletedView(view, rgb, 0.5 * view.mask, view.mask, 2 * view.depth), state

    camera = view_camera(Camera(azimuth=30.0, elevation=8.0, distance=frame.distance_m), frame, (420, 330))
    telling = Stream(Tells(), stream.config)
    telling.push(stream.observation().frame, stream.observation().proxy)
    for completed in (telling.view(camera).completed, telling.mend(telling.render(camera)).completed):
        assert completed.rgb.shape == (3, 330, 420)
        assert torch.equal(completed.alpha, 0.5 * completed.view.mask)
        assert torch.equal(completed.confidence, completed.view.mask)
        assert torch.equal(completed.depth, 2 * completed.view.depth)
        assert bool((completed.rgb[:, completed.view.error > 0] == 0.5).all())
