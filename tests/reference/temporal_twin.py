"""Slow, obvious twin of viewmend.training.temporal_loss.temporal_change: one pixel at a time, in double precision."""

import torch
from reference.carry_twin import carry_twin
from reference.rays_twin import four_beyond


def temporal_twin(before, now, tolerance, truth=None):
    view, past = now.view, before.view
    earlier, later = before.rgb.double(), now.rgb.double()
    if truth is not None:
        earlier, later = earlier - truth[0], later - truth[1]
    height, width = past.depth.shape
    total, weights = torch.zeros((), dtype=torch.float64), 0.0
    for row in range(view.depth.shape[0]):
        for column in range(view.depth.shape[1]):
            if view.mask[row, column] <= 0.5 or view.depth[row, column] <= 0:
                continue
            at = torch.tensor([[[column + 0.5, row + 0.5]]])
            uv, z = carry_twin(at, view.depth[row, column].view(1, 1), view.camera, past.camera)
            if z[0, 0] <= 0:
                continue
            colour, error, one_surface = 0, 0.0, True
            for v, u, share in four_beyond(*((uv[0, 0] - 0.5) * 256).round() / 256 + 0.5):
                if share == 0:
                    continue
                if not (0 <= v < height and 0 <= u < width) or past.mask[v, u] <= 0.5 or past.depth[v, u] <= 0:
                    one_surface = False
                    break
                one_surface &= bool(abs(float(past.depth[v, u]) - z[0, 0]) <= tolerance * z[0, 0])
                colour = colour + share * earlier[:, v, u]
                error += share * float(past.error[v, u])
            if one_surface:
                weight = max(error, float(view.error[row, column]))
                total = total + weight * (later[:, row, column] - colour).abs().mean()
                weights += weight
    return total / weights if weights else total
