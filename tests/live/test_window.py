"""Working on the subject's window alone changes nothing but the time it takes."""

import pytest
import torch

from viewmend.inpainting.checkpoint import load_inpainter
from viewmend.live.poses import rig_frame, view_camera
from viewmend.live.protocol import Camera
from viewmend.live.window import Window, window_of
from viewmend.stream import RenderQuality, Stream
from viewmend.studio.stage import Studio, StudioConfig

PLAIN = RenderQuality(context_times=0)


@pytest.fixture(scope="module")
def scene():
    studio = Studio(StudioConfig(seed=7, cameras=6, frames=1, size_px=96))
    stream = Stream(load_inpainter("small"), bounds=studio.bounds)
    observation = stream.push(studio.read(0))
    return stream, rig_frame(studio.cameras, observation.proxy.mesh.vertices.mean(0), studio.up), observation.proxy


@pytest.mark.parametrize(("azimuth", "distance"), [(20.0, 1.0), (75.0, 1.0), (140.0, 0.6)])
def test_the_same_picture_as_of_the_whole_view(scene, azimuth, distance):
    stream, frame, proxy = scene
    asked = Camera(azimuth=frame.azimuth + azimuth, elevation=8.0, distance=distance * frame.distance_m)
    camera = view_camera(asked, frame, (200, 160))
    window = window_of(proxy.mesh.vertices, camera)
    assert window is not None
    whole = stream.view(camera, effort=PLAIN).completed
    part = window.widened(stream.view(window.of(camera), effort=PLAIN).completed, camera)
    assert bool((whole.view.error > 0).any())
    # Edges of triangles may fall on the other side of a pixel's centre, by rounding.
    assert int(((whole.view.mask != part.view.mask) | (whole.view.error != part.view.error)).sum()) <= 2
    off = (whole.rgb - part.rgb).abs().amax(0)
    assert float(off.mean()) < 1e-4
    assert float((off > 2 / 255).float().mean()) < 1e-3  # holes so deep that a smooth fill is coarser than the grid
    assert part.view.camera is camera
    assert whole.view.weights.shape == part.view.weights.shape


def test_a_view_without_holes_shown_keeps_its_identity(scene):
    stream, frame, proxy = scene
    camera = view_camera(Camera(azimuth=frame.azimuth), frame, (200, 160))
    window = window_of(proxy.mesh.vertices, camera)
    assert window is not None
    part = window.widened(stream.view(window.of(camera), effort=RenderQuality(mend=False)).completed, camera)
    assert part.rgb is part.view.rgb


def test_windows_lie_within_the_view(scene):
    _, frame, proxy = scene
    away = view_camera(Camera(azimuth=0.0, target=(5.0, 0.0, 0.0)), frame, (64, 48))
    window = window_of(proxy.mesh.vertices, away)
    assert window is None or (window.left < window.right <= 64 and window.top < window.bottom <= 48)
    near = view_camera(Camera(distance=0.05), frame, (64, 48))
    assert window_of(proxy.mesh.vertices, near) is None  # some of the subject is behind
    assert window_of(torch.zeros(0, 3), away) is None


def test_a_windows_camera_sees_the_same_rays(scene):
    _, frame, _ = scene
    camera = view_camera(Camera(), frame, (64, 48))
    seen = Window(16, 0, 40, 30).of(camera)
    assert seen.max_size_px == (24, 30)
    assert float(seen.K[0, 0, 2]) == pytest.approx(float(camera.K[0, 0, 2]) - 16)
