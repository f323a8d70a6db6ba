"""The studio's shading in PyTorch, sample by sample: the reference of its compiled loops."""

import torch
from einops import reduce

from viewmend.geometry.cameras import project
from viewmend.geometry.rasterize import Raster, interpolate
from viewmend.studio.render import GLOSS_DOUBLINGS, SHADOW_BIAS_M
from viewmend.utils.srgb import srgb_from_linear


def unshadowed(pixels, z, depth):
    """Share of the four nearest texels of each shadow map that lie no nearer to the light than the vertex."""
    corner = (pixels - 0.5).floor()
    fraction = pixels - 0.5 - corner
    seen = torch.zeros_like(z)
    view = torch.arange(len(z), device=z.device)[:, None]
    for x, wx in ((0, 1 - fraction[..., 0]), (1, fraction[..., 0])):
        for y, wy in ((0, 1 - fraction[..., 1]), (1, fraction[..., 1])):
            column = (corner[..., 0].long() + x).clamp(0, depth.shape[2] - 1)
            row = (corner[..., 1].long() + y).clamp(0, depth.shape[1] - 1)
            seen += wx * wy * (z < depth[view, row, column] + SHADOW_BIAS_M)
    return seen


def shade(surface, fine, triangle, background):
    """Colour and coverage of each pixel from the triangles that its samples see."""
    n = triangle.shape[1] // background.shape[2]
    images, masks = [], []
    for view in range(len(fine)):
        seen = triangle[view] >= 0
        color = torch.zeros(*seen.shape, 3, device=seen.device)
        color[seen] = _sample_colors(surface, fine[view], triangle[view : view + 1])
        cover = reduce(seen.float(), "(h a) (w b) -> h w", "mean", a=n, b=n)
        linear = reduce(color, "(h a) (w b) c -> c h w", "mean", a=n, b=n) + (1 - cover) * background[view]
        images.append((srgb_from_linear(linear) * 255).round().to(torch.uint8))
        masks.append((cover * 255).round().to(torch.uint8))
    return torch.stack(images), torch.stack(masks)


def _sample_colors(surface, camera, triangle):
    """Linear light of the covered samples of one view."""
    scene, lights = surface.scene, surface.lights
    levels = face_levels(scene, camera, surface.pyramid)
    raster = Raster(torch.zeros(triangle.shape), triangle)
    values = torch.cat([scene.uv, scene.normals, surface.irradiance, scene.mesh.vertices], 1)
    shown = interpolate(values, scene.mesh, camera, raster)[triangle >= 0]
    face = triangle[triangle >= 0].long()
    uv, normal, lit, place = shown.split((2, 3, 3, 3), 1)
    albedo = sample_texture(surface.pyramid, scene.texture_of_face.long()[face], uv, levels[face])
    return albedo * lit + lit * _highlight(normal, camera.centers[0] - place, lights)


def _highlight(normal, toward_camera, lights):
    """Blinn-Phong highlights of all lamps."""
    normal = torch.nn.functional.normalize(normal, dim=-1)
    eye = torch.nn.functional.normalize(toward_camera, dim=-1)
    total = torch.zeros_like(normal)
    for lamp, gloss in zip(lights.lamps, lights.gloss, strict=True):
        half = torch.nn.functional.normalize(eye + lamp, dim=-1)
        power = (half * normal).sum(-1).clamp(min=0)
        for _ in range(GLOSS_DOUBLINGS):
            power = power * power
        total += power[:, None] * gloss
    return total


def face_levels(scene, camera, pyramid):
    """The pyramid level, with fraction, at which a texel of each face is about as large as a pixel."""
    faces = scene.mesh.faces.long()
    pixels, z = (found[0][faces] for found in project(scene.mesh.vertices, camera))
    corners = scene.uv[faces] * pyramid.size[scene.texture_of_face.long(), 0][:, None]
    level = 0.5 * torch.log2((_area(corners) / _area(pixels).clamp(min=1e-6)).clamp(min=1e-6))
    # A face across the camera plane has no meaningful area: it is too near to need a smaller texture.
    return level.masked_fill((z <= 0).any(-1), 0).clamp(0, pyramid.first.shape[1] - 1)


def _area(triangles):
    a, b = triangles[..., 1, :] - triangles[..., 0, :], triangles[..., 2, :] - triangles[..., 0, :]
    return (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]).abs() / 2


def sample_texture(pyramid, texture, uv, level):
    """Trilinear look-up, clamped at the textures' edges; linear light."""
    low = level.floor().long()
    high = (low + 1).clamp(max=pyramid.first.shape[1] - 1)
    below, above = (_bilinear(pyramid, texture, uv, at) for at in (low, high))
    return torch.lerp(below, above, (level - low)[:, None])


def _bilinear(pyramid, texture, uv, level):
    size, first = pyramid.size[texture, level], pyramid.first[texture, level]
    place = (uv * size - 0.5).clamp(min=0).minimum(size - 1)
    corner = place.floor().long()
    fraction = place - corner
    beyond = (corner + 1).minimum(size - 1)
    blended = torch.zeros(len(uv), 3, device=uv.device)
    for x, wx in ((corner[:, 0], 1 - fraction[:, 0]), (beyond[:, 0], fraction[:, 0])):
        for y, wy in ((corner[:, 1], 1 - fraction[:, 1]), (beyond[:, 1], fraction[:, 1])):
            blended += (wx * wy)[:, None] * pyramid.texels[first + y * size[:, 0] + x]
    return blended
