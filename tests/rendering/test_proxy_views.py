"""Images of the proxy: shading, visibility and the order of dots."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from reference.ball import camera_at, proxy
from torch.nn.functional import normalize

from viewmend.geometry.cameras import project, unproject
from viewmend.geometry.mesh import Mesh
from viewmend.rendering import proxy_views
from viewmend.rendering.proxy_views import (
    BEHIND,
    CLAY,
    DOT,
    GRAZING,
    MAX_DOT_PX,
    hull_points,
    shaded_hull,
    vertex_colours,
)
from viewmend.types import ContextViews, MultiViewFrame

BALL = proxy(24)
COLOURS = 0.5 + 0.4 * BALL.normals


def test_a_ball_is_brightest_where_it_faces_the_viewer_and_dark_at_its_rim():
    shown = shaded_hull(BALL, camera_at(30, "t", size=96))
    clay = torch.tensor(CLAY)
    assert torch.allclose(shown[:3, 48, 48], clay, atol=0.01) and shown[3, 48, 48] == 1
    assert float(shown[:, 0, 0].abs().max()) == 0
    row = shown[0, 48][shown[3, 48] == 1] / clay[0]
    assert row[0] < GRAZING + 0.3 > row[-1] and (row[: len(row) // 2].diff() > -0.02).all()
    # Sun and viewer are one: a view from elsewhere of a ball is the same.
    other = shaded_hull(BALL, camera_at(200, "t", size=96))
    both = (shown[3] > 0) & (other[3] > 0)
    assert both.sum() > 1000 and float((shown[0] - other[0])[both].abs().mean()) < 0.01


def by_hand(ball, colours, camera):
    """Slow reference of `hull_points`, dot by dot."""
    width, height = camera.max_size_px
    surface = ball.depth(camera)[0]
    first, second = (ball.mesh.vertices[ball.mesh.faces[:, corner].long()] for corner in (0, 1))
    apart = float((first - second).norm(dim=-1).median())
    nearest, image = np.full((height, width), np.inf), np.zeros((4, height, width), np.float32)
    uv, z = project(ball.mesh.vertices, camera)
    for (u, v), depth, colour in zip(uv[0].tolist(), z[0].tolist(), colours.tolist(), strict=True):
        column, row = int(u), int(v)
        if depth <= 0 or not (0 <= u < width and 0 <= v < height):
            continue
        if surface[row, column] > 0 and depth > float(surface[row, column]) + BEHIND * apart:
            continue
        side = max(1, round(DOT * apart * float(camera.K[0, 0, 0]) / depth))
        for y in range(max(0, row - side // 2), min(height, row - side // 2 + side)):
            for x in range(max(0, column - side // 2), min(width, column - side // 2 + side)):
                if depth < nearest[y, x]:
                    nearest[y, x], image[:3, y, x], image[3, y, x] = depth, colour, 1
    return image


@pytest.mark.parametrize("distance_m", [2.0, 0.9])
def test_points_equal_the_reference(distance_m):
    camera = camera_at(75, "t", size=80, distance_m=distance_m, height_m=0.3)
    shown, wanted = hull_points(BALL, COLOURS, camera).numpy(), by_hand(BALL, COLOURS, camera)
    assert 0.1 < wanted[3].mean() < 0.9, "dots with gaps between them"
    assert (np.abs(shown - wanted).max(0) > 1e-6).mean() < 0.003  # of two that are as near either may win


def test_the_size_of_near_dots_is_bounded():
    vertices = torch.tensor(
        [[0.0, 0, 1.99], [3, 0, -1], [0, 3, -1]]
    )  # a centimetre before it, and two out of view
    near = replace(BALL, mesh=Mesh(vertices, torch.tensor([[0, 1, 2]]).int()), normals=torch.eye(3))
    dot = hull_points(near, torch.ones(3, 3), camera_at(0, "t", size=96))[3]
    assert float(dot.sum()) == MAX_DOT_PX**2 and float(dot[48, 48]) == 1


def test_a_dot_in_the_last_row_and_column_is_drawn_there():
    camera = camera_at(0, "t", size=96)
    corner = unproject(torch.tensor([[[95.5, 95.5]]]), torch.ones(1, 1), camera)[0]
    vertices = torch.cat([corner, torch.tensor([[3.0, 0, -1], [0, 3, -1]])])
    near = replace(BALL, mesh=Mesh(vertices, torch.tensor([[0, 1, 2]]).int()), normals=torch.eye(3))
    dot = hull_points(near, torch.ones(3, 3), camera)[3]
    assert dot.nonzero().amin(0).tolist() == [95 - MAX_DOT_PX // 2] * 2


def test_an_empty_proxy_gives_an_empty_image():
    none = replace(BALL, mesh=Mesh(torch.zeros(0, 3), torch.zeros(0, 3).int()), normals=torch.zeros(0, 3))
    camera = camera_at(0, "t", size=32)
    away = camera_at(180, "t", size=32, distance_m=-2.0)
    assert (
        hull_points(none, torch.zeros(0, 3), camera).abs().max() == 0 == shaded_hull(none, camera).abs().max()
    )
    assert hull_points(BALL, COLOURS, away).shape == (4, 32, 32)


def test_vertices_that_no_camera_sees_have_the_colour_of_their_neighbours():
    camera = camera_at(0, "front")
    width, height = camera.max_size_px
    red = torch.tensor([200, 40, 10], dtype=torch.uint8)
    rgb = red[:, None, None].expand(1, 3, height, width).contiguous()
    frame = MultiViewFrame(camera, rgb, (BALL.depth(camera) > 0).to(torch.uint8) * 255, 0)
    to_camera = normalize(camera.centers - BALL.mesh.vertices, dim=-1)
    behind = (BALL.normals * to_camera).sum(-1) < 0
    colours = vertex_colours(BALL, ContextViews(frame, BALL.depth(camera)))
    assert behind.sum() > 100
    assert torch.allclose(colours, (red / 255).expand_as(colours), atol=0.01)


def test_hidden_vertices_get_the_mean_of_all_neighbours():
    """Also at the border of a mesh, where a neighbour comes after the vertex in no face."""
    mesh = Mesh(torch.eye(3), torch.tensor([[0, 1, 2]], dtype=torch.int32))
    colours = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    spread = proxy_views._spread(colours, torch.tensor([True, True, False]), mesh)
    assert spread.tolist() == [[1, 0, 0], [0, 0, 1], [0.5, 0, 0.5]]
