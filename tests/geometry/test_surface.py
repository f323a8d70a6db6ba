"""The surface of an occupancy grid."""

import numpy as np
import pytest
import torch
from geometry.solids import is_closed, volume

from viewmend.geometry.hull import OccupancyGrid
from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.geometry.surface import extract_surface, march_numba, march_torch

LOW = torch.tensor([1.0, -2.0, 0.5])


def ball_grid(cells: int = 24, radius: float = 0.8, center=(0.0, 0.0, 0.0)) -> OccupancyGrid:
    """A ball in the cube of side 2 whose low corner is at LOW; occupancy falls linearly at its surface."""
    at = (torch.arange(cells) + 0.5) * (2 / cells) - 1
    points = torch.stack(torch.meshgrid(at, at, at, indexing="ij"), -1)
    distance = (points - torch.tensor(center)).norm(dim=-1) - radius
    return OccupancyGrid((0.5 - distance * cells / 4).clamp(0, 1), LOW, 2 / cells)


def test_a_ball_is_round_closed_and_outward():
    mesh = extract_surface(ball_grid())
    center = LOW + 1
    assert ((mesh.vertices - center).norm(dim=1) - 0.8).abs().max() < 0.1 * 2 / 24
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.01)
    assert is_closed(mesh)
    outward = torch.nn.functional.normalize(mesh.vertices - center, dim=1)
    assert ((vertex_normals(mesh) * outward).sum(1) > 0.95).all()


def test_a_body_that_leaves_the_volume_is_capped():
    grid = ball_grid(center=(0.7, 0.0, -0.5))
    assert (grid.values[-1] > 0.5).any()
    mesh = extract_surface(grid)
    assert is_closed(mesh) and volume(mesh) > 0
    assert mesh.vertices[:, 0].max() <= LOW[0] + 2 + grid.voxel_m / 2


@pytest.mark.parametrize("seed", range(4))
def test_noise_gives_a_closed_surface_too(seed):
    """Every ambiguous configuration of cells, next to every other; values exactly at one half among them."""
    rng = torch.Generator().manual_seed(seed)
    values = torch.rand(12, 10, 11, generator=rng)
    values[values > 0.9] = 0.5
    mesh = extract_surface(OccupancyGrid(values, LOW, 0.1))
    assert is_closed(mesh) and torch.isfinite(mesh.vertices).all()


def test_numba_equals_torch():
    values = torch.nn.functional.pad(
        torch.rand(9, 12, 10, generator=torch.Generator().manual_seed(9)), (1,) * 6
    )
    values[values > 0.8] = 0.5  # which is outside, for all who count
    fast, slow = Mesh(*march_numba(values)), Mesh(*march_torch(values))
    assert torch.equal(fast.faces, slow.faces)
    torch.testing.assert_close(fast.vertices, slow.vertices)
    # Gradients take the path in torch. Where the faces around a vertex all but cancel, rounding decides the direction.
    slow_normals = vertex_normals(Mesh(slow.vertices.requires_grad_(), slow.faces)).detach()
    agree = torch.nn.functional.cosine_similarity(vertex_normals(fast), slow_normals) > 0.999
    assert agree.float().mean() > 0.99


def test_an_empty_grid_gives_an_empty_mesh_and_a_full_one_a_box():
    empty, full = (extract_surface(OccupancyGrid(of(3, 4, 5), LOW, 0.1)) for of in (torch.zeros, torch.ones))
    assert empty.vertices.shape == empty.faces.shape == (0, 3)
    assert is_closed(full) and volume(full) == pytest.approx(0.3 * 0.4 * 0.5, rel=0.2)
