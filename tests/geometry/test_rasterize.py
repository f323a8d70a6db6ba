"""Drawing meshes: the slow twin, both fast paths, and the cases where rasterisers go wrong."""

import numpy as np
import pytest
import torch
from geometry.solids import ball_mesh, camera_at, dome
from reference.ball import proxy, ring
from reference.raster_twin import raster_twin

from viewmend.geometry._rasterize_numba import pixel_box
from viewmend.geometry.cameras import Cameras, concatenate_cameras, pixel_centers, unproject
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import Raster, interpolate, rasterize, rasterize_torch

SIDE = {"none": 0, "back": 1, "front": -1}


def in_torch(mesh: Mesh, cameras: Cameras, cull: str = "none") -> Raster:
    return rasterize_torch(mesh, cameras, SIDE[cull])


@pytest.fixture(params=[rasterize, in_torch])
def draw(request):
    """Both fast paths."""
    return request.param


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
    return ball_mesh(1), skewed(concatenate_cameras(views))


@pytest.mark.parametrize("cull", ["none", "back", "front"])
def test_equals_the_twin(ball_scene, draw, cull):
    mesh, cameras = ball_scene
    depth, triangle, margin = raster_twin(mesh, cameras, cull)
    raster = draw(mesh, cameras, cull)
    # Single precision decides otherwise only where a pixel's centre is all but on an edge.
    clear = torch.from_numpy(margin > 1e-4)
    assert clear.float().mean() > 0.97
    assert (raster.triangle == torch.from_numpy(triangle))[clear].all()
    torch.testing.assert_close(
        raster.depth.double()[clear], torch.from_numpy(depth)[clear], rtol=1e-5, atol=0
    )
    assert (raster.triangle >= 0).any(-1).any(-1).all()


def test_many_chunks_draw_what_one_does(ball_scene, monkeypatch):
    mesh, cameras = ball_scene
    whole = in_torch(mesh, cameras)
    monkeypatch.setattr("viewmend.geometry.rasterize.CANDIDATES", 100)
    assert torch.equal(in_torch(mesh, cameras).depth, whole.depth)


def test_a_closed_surface_has_no_cracks(draw):
    """Seen from inside, a closed mesh covers every pixel, shared edges and corners included."""
    inside = camera_at((0.01, 0.02, 0.03), target=(1.0, 0.0, 0.0), width=64, height=64, fov=2.0)
    assert (draw(ball_mesh(4), inside).triangle >= 0).all()


def test_what_is_behind_a_camera_draws_nothing(draw):
    raster = draw(ball_mesh(), camera_at((2.0, 0.0, 0.0), target=(4.0, 0.0, 0.0)))
    assert (raster.triangle == -1).all() and (raster.depth == 0).all()


def test_back_faces_are_those_turned_away(draw):
    mesh, camera = ball_mesh(), camera_at((2.0, 0.3, 0.0))
    front, back = draw(mesh, camera, "back"), draw(mesh, camera, "front")
    covered = front.triangle >= 0
    assert torch.equal(front.depth, draw(mesh, camera).depth)
    assert (front.depth < back.depth)[covered & (back.triangle >= 0)].all()
    assert float(front.depth[covered].min()) == pytest.approx((4 + 0.09) ** 0.5 - 0.5, abs=0.02)


def test_nothing_is_drawn_beyond_a_views_own_size(draw):
    views = [camera_at((0.9, 0, 0), width=40, height=30), camera_at((0, 0, 0.9), width=20, height=50)]
    raster = draw(ball_mesh(), concatenate_cameras(views))
    assert raster.depth.shape == (2, 50, 40)
    assert (raster.triangle[0, 30:] == -1).all() and (raster.triangle[1, :, 20:] == -1).all()
    assert (raster.triangle[1, :, 19] >= 0).any()


def test_an_empty_mesh_draws_nothing(draw):
    empty = Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32))
    raster = draw(empty, dome(2))
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


@pytest.mark.gpu
def test_cuda_equals_cpu():
    mesh, cameras = ball_mesh(4), dome(5, width=120, height=90)
    there = rasterize(mesh.to("cuda"), cameras.to("cuda"))
    here = rasterize(mesh, cameras)
    assert (there.triangle.cpu() != here.triangle).float().mean() < 1e-4


# The CPU's fast path of `interpolate` against the path for any device, which gradients take.


def test_the_fast_path_equals_the_other():
    ball, cameras = proxy(16), ring(3, 40).cropped(-4, 6, 50, 40)
    raster = rasterize(ball.mesh, cameras)
    attributes = torch.randn(len(ball.mesh.vertices), 5, generator=torch.Generator().manual_seed(0))
    fast = interpolate(attributes, ball.mesh, cameras, raster)
    slow = interpolate(attributes.clone().requires_grad_(), ball.mesh, cameras, raster)
    assert slow.requires_grad and (raster.triangle >= 0).float().mean() > 0.2
    torch.testing.assert_close(fast, slow.detach(), atol=1e-4, rtol=1e-4)


def test_gradients_reach_the_attributes():
    ball, cameras = proxy(8), ring(1, 20)
    attributes = torch.ones(len(ball.mesh.vertices), 1, requires_grad=True)
    raster = rasterize(ball.mesh, cameras)
    interpolate(attributes, ball.mesh, cameras, raster).sum().backward()
    assert attributes.grad is not None
    torch.testing.assert_close(attributes.grad.sum(), (raster.triangle >= 0).sum().float())


# The box of pixels in which a face is drawn; pixels that are in the box in vain only cost time.


def corner(u_px: float, v_px: float, z: float = 1.0) -> np.ndarray:
    """A row that `project_vertices` writes."""
    return np.array([u_px * z, v_px * z, z, u_px, v_px])


@pytest.mark.parametrize(
    ("columns_px", "columns"),
    [
        ((2.5, 5.5), (2, 6)),  # centres on the face's border belong to it
        ((2.51, 5.49), (3, 5)),
        ((-3.0, 0.2), (0, 0)),  # it ends before the first centre
        ((9.6, 14.0), (10, 10)),  # it begins after the last one
        ((-1e9, 1e9), (0, 10)),
    ],
)
def test_a_face_is_drawn_only_where_it_may_have_pixels(columns_px, columns):
    low, high = columns_px
    across = [corner(low, 1.5), corner(high, 1.5), corner(low, 4.5)]
    down = [corner(1.5, low), corner(1.5, high), corner(4.5, low)]
    assert pixel_box(*across, 1e-6, (0, 10), (0, 8)) == (*columns, 1, 5)
    assert pixel_box(*down, 1e-6, (0, 8), (0, 10)) == (1, 5, *columns)


def test_a_face_that_reaches_behind_the_camera_may_have_all_pixels():
    behind = corner(2.5, 2.5, -1.0)
    at_near = corner(2.5, 2.5, 1e-6)
    assert pixel_box(corner(1.0, 1.0), corner(3.0, 1.0), behind, 1e-6, (0, 10), (2, 8)) == (0, 10, 2, 8)
    assert pixel_box(corner(1.0, 1.0), corner(3.0, 1.0), at_near, 1e-6, (0, 10), (2, 8)) == (0, 10, 2, 8)
    assert pixel_box(behind, behind, at_near, 1e-6, (0, 10), (2, 8)) == (0, 0, 0, 0)
