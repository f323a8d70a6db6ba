"""Looking up images at pixel positions, against one position and one pixel at a time."""

from dataclasses import replace

import pytest
import torch
from reference.ball import ring

from viewmend.geometry.cameras import project
from viewmend.geometry.sampling import bilinear_taps, in_view, sample_bilinear


def sample_twin(image, u, v, padding):
    """One channel at one position, pixel centres at half-integers."""
    height, width = image.shape
    total = 0.0
    for row in range(-8, height + 8):
        for column in range(-8, width + 8):
            weight = max(0.0, 1 - abs(u - column - 0.5)) * max(0.0, 1 - abs(v - row - 0.5))
            inside = 0 <= row < height and 0 <= column < width
            if padding == "border":
                row_there, column_there = min(max(row, 0), height - 1), min(max(column, 0), width - 1)
                total += weight * float(image[row_there, column_there])
            elif inside:
                total += weight * float(image[row, column])
    return total


@pytest.mark.parametrize("padding", ["zeros", "border"])
def test_samples_equal_their_twin(rng, padding):
    images = torch.rand(2, 3, 5, 7, generator=rng)
    uv = torch.rand(2, 20, 2, generator=rng) * torch.tensor([11.0, 9.0]) - 2
    uv[:, 0] = torch.tensor([0.5, 0.5])
    uv[:, 1] = torch.tensor([7.0, 5.0])
    found = sample_bilinear(images, uv, padding)
    assert torch.allclose(found[:, 0], images[:, :, 0, 0], atol=1e-6), (
        "a pixel's centre has the pixel's colour"
    )
    for view in range(2):
        for point, (u, v) in enumerate(uv[view].tolist()):
            twin = [sample_twin(channel, u, v, padding) for channel in images[view]]
            assert found[view, point].tolist() == pytest.approx(twin, abs=1e-5)
    view = torch.arange(2)[:, None]
    taps = bilinear_taps(uv, ring(2).resized(7, 5))
    read = taps.weight[..., None] * images.movedim(1, -1)[view, taps.row, taps.column]
    assert padding == "zeros" or torch.allclose(read.sum(0), found, atol=1e-5)


@pytest.mark.parametrize("far", [1e9, -1e9, 3e38, -3e38])
def test_what_is_far_outside_stays_outside(far):
    images, uv = torch.ones(1, 1, 4, 6), torch.tensor([[[far, 2.0], [3.0, far], [far, far]]])
    assert not sample_bilinear(images, uv).any()
    assert bool((sample_bilinear(images, uv, "border") == 1).all())


def test_in_view_is_before_the_camera_and_inside_its_own_image(rng):
    cameras = ring(4)
    cameras = replace(cameras, size_px=cameras.size_px - torch.tensor([[0, 0], [9, 0], [0, 20], [3, 4]]))
    points = 4 * torch.rand(300, 3, generator=rng) - 2
    uv, z = project(points, cameras)
    found = in_view(uv, z, cameras)
    assert 0.1 < found.float().mean() < 0.9
    for view, (width, height) in enumerate(cameras.size_px.tolist()):
        for point in range(300):
            (u, v), depth = uv[view, point].tolist(), float(z[view, point])
            assert bool(found[view, point]) == (depth > 0 and 0 <= u < width and 0 <= v < height)
    edge = torch.tensor([[[0.0, 0.0], [float(cameras.size_px[0, 0]), 1.0]]])
    assert in_view(edge, torch.ones(1, 2), cameras[0]).tolist() == [[True, False]]
