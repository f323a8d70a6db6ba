"""Drawing meshes: the slow twin, and the cases where rasterisers go wrong."""

import pytest
import torch
from geometry.solids import ball_mesh, camera_at, dome
from reference.raster_twin import raster_twin

from viewmend.geometry.cameras import Cameras, concatenate_cameras, pixel_centers, unproject
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import interpolate, rasterize


def skewed(cameras: Cameras) -> Cameras:
    K = cameras.K.clone()
    K[:, 0, 1] = 3.0
    K[:, 0, 2] -= 4.3
    return Cameras(cameras.names, K, cameras.camera_from_world, cameras.size_px)


@pytest.fixture(scope="module")
def ball_scene() -> tuple[Mesh, Cameras]:
    """Views of different sizes, with skew, one of them so close that triangles reach behind it."""
    views = [
        camera_at((1.5, 0.4, 0.3), width=24, height=20),
        camera_at((0.2, -0.3, -1.5), width=18, height=25),
        camera_at((0.0, 0.45, 0.3), target=(0.0, 0.1, 0.0), width=20, height=20, fov=1.5),
    ]
    return ball_mesh(7, 10), skewed(concatenate_cameras(views))


@pytest.mark.parametrize("cull", ["none", "back", "front"])
def test_equals_the_twin(ball_scene, cull):
    mesh, cameras = ball_scene
    depth, triangle, margin = raster_twin(mesh, cameras, cull)
    raster = rasterize(mesh, cameras, cull)
    # Single precision decides otherwise only where a pixel's centre is all but on an edge.
    clear = torch.from_numpy(margin > 1e-4)
    assert clear.float().mean() > 0.97
    assert (raster.triangle == torch.from_numpy(triangle))[clear].all()
    torch.testing.assert_close(raster.depth.double()[clear], torch.from_numpy(depth)[clear], rtol=1e-5, atol=0)
    assert (raster.triangle >= 0).any(-1).any(-1).all()


def test_a_closed_surface_has_no_cracks():
    """Seen from inside, a closed mesh covers every pixel, shared edges and corners included."""
    inside = camera_at((0.01, 0.02, 0.03), target=(1.0, 0.0, 0.0), width=64, height=64, fov=2.0)
    assert (rasterize(ball_mesh(40, 60), inside).triangle >= 0).all()


def test_what_is_behind_a_camera_draws_nothing():
    away = camera_at((2.0, 0.0, 0.0), target=(4.0, 0.0, 0.0))
    raster = rasterize(ball_mesh(), away)
    assert (raster.triangle == -1).all()
    assert (raster.depth == 0).all()


def test_back_faces_are_those_turned_away():
    mesh, camera = ball_mesh(), camera_at((2.0, 0.3, 0.0))
    front, back = rasterize(mesh, camera, "back"), rasterize(mesh, camera, "front")
    covered = front.triangle >= 0
    assert torch.equal(front.depth, rasterize(mesh, camera).depth)
    assert (front.depth < back.depth)[covered & (back.triangle >= 0)].all()
    assert float(front.depth[covered].min()) == pytest.approx((4 + 0.09) ** 0.5 - 0.5, abs=0.02)


def test_nothing_is_drawn_beyond_a_views_own_size():
    near = concatenate_cameras(
        [camera_at((0.9, 0, 0), width=40, height=30), camera_at((0, 0, 0.9), width=20, height=50)]
    )
    raster = rasterize(ball_mesh(), near)
    assert raster.depth.shape == (2, 50, 40)
    assert (raster.triangle[0, 30:] == -1).all()
    assert (raster.triangle[1, :, 20:] == -1).all()
    assert (raster.triangle[1, :, 19] >= 0).any()


def test_an_empty_mesh_draws_nothing():
    empty = Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32))
    raster = rasterize(empty, dome(2))
    assert (raster.triangle == -1).all()
    assert interpolate(torch.zeros(0, 2), empty, dome(2), raster).shape == (2, 80, 96, 2)


def test_interpolation_is_perspective_correct(ball_scene):
    """Interpolated world positions are where the pixel's ray meets its depth."""
    mesh, cameras = ball_scene
    raster = rasterize(mesh, cameras)
    width, height = cameras.max_size_px
    pixels = pixel_centers(width, height).reshape(1, -1, 2).expand(len(cameras), -1, -1)
    world = unproject(pixels, raster.depth.flatten(1), cameras).view(*raster.depth.shape, 3)
    covered = raster.triangle >= 0
    positions = interpolate(mesh.vertices, mesh, cameras, raster)
    torch.testing.assert_close(positions[covered], world[covered], atol=2e-6, rtol=1e-5)
    assert (positions[~covered] == 0).all()
