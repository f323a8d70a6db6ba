"""The colours of a mesh's vertices, from the cameras that see them."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from viewmend.geometry.cameras import project
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.sampling import in_view, sample_bilinear
from viewmend.views import ContextViews

FRONTAL_POWER = 4
"""Exponent of the cosine between a vertex's normal and the direction to a camera."""
BIAS = 0.01
"""A vertex is hidden if it lies this much behind the proxy's depth, as a share of the box that was carved."""
LEAST_MASK = 0.5
"""Share of a sample that must be subject for it to count."""
LEAST_WEIGHT = 1e-4
"""Vertices with less count as unseen: the cameras merely graze them."""
GREY = 0.5
"""What vertices show that are connected to none that any camera sees."""


def vertex_colours(proxy: GeometryProxy, views: ContextViews) -> Float[Tensor, "vertex 3"]:
    """RGB in [0, 1], as cameras store it: the mean of those that see a vertex, frontal ones counting most.

    What no camera sees takes the colour of the nearest vertices along the mesh that have one.
    """
    vertices, frame = proxy.mesh.vertices, views.frame
    bias_m = BIAS * float(proxy.bounds.size_m.norm())
    total = vertices.new_zeros(len(vertices), 4)
    for view in range(len(frame.cameras)):
        camera = frame.cameras[view]
        uv, z = project(vertices, camera)
        rgb = frame.rgb[view].to(vertices) / 255
        depth = views.depth[view]
        mask = (depth > 0).to(rgb) if frame.mask is None else frame.mask[view].to(rgb) / 255
        seen = sample_bilinear(torch.cat([rgb * mask, mask[None]])[None], uv)[0]
        column, row = uv[0].long().unbind(-1)
        own = depth[row.clamp(0, depth.shape[0] - 1), column.clamp(0, depth.shape[1] - 1)]
        visible = in_view(uv, z, camera)[0] & (own > 0) & (z[0] <= own + bias_m) & (seen[:, 3] > LEAST_MASK)
        towards = torch.nn.functional.normalize(camera.centers - vertices, dim=-1)
        cosine = (proxy.normals * towards).sum(-1).clamp(min=0)
        weight = visible * cosine**FRONTAL_POWER
        total += weight[:, None] * torch.cat(
            [seen[:, :3] / seen[:, 3:].clamp(min=LEAST_MASK), torch.ones_like(z.mT)], 1
        )
    known = total[:, 3] > LEAST_WEIGHT
    return _spread(
        torch.where(known[:, None], total[:, :3] / total[:, 3:].clamp(min=LEAST_WEIGHT), GREY), known, proxy.mesh
    )


def _spread(colours: Float[Tensor, "vertex 3"], known: Tensor, mesh: Mesh) -> Float[Tensor, "vertex 3"]:
    """The colours, those of unknown vertices from their neighbours', ring by ring."""
    edges = _edges(mesh)
    while True:
        reached = edges[known[edges[:, 0]] & ~known[edges[:, 1]]]
        if not len(reached):
            return colours
        sums = colours.new_zeros(len(colours), 4)
        ones = colours.new_ones(len(reached), 1)
        sums.index_add_(0, reached[:, 1], torch.cat([colours[reached[:, 0]], ones], 1))
        new = sums[:, 3] > 0
        colours = torch.where(new[:, None], sums[:, :3] / sums[:, 3:].clamp(min=1), colours)
        known = known | new


def _edges(mesh: Mesh) -> Int[Tensor, "edge 2"]:
    """Both directions of every triangle's sides; some twice."""
    faces = mesh.faces.long()
    sides = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return torch.cat([sides, sides.flip(1)])
