"""Draws the stage into cameras: anti-aliased colour, soft mask, exact depth."""

from dataclasses import dataclass, replace

import torch
from einops import reduce
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.rasterize import Raster, barycentric, rasterize
from viewmend.geometry.threads import parallel_for
from viewmend.studio import _shade_numba as kernels
from viewmend.studio.performer import TexturedMesh
from viewmend.studio.shading import GLOSS_DOUBLINGS, Lights, irradiance
from viewmend.studio.textures import TexturePyramid, face_levels, sample_texture, srgb_from_linear
from viewmend.views import MultiViewFrame

BANDS = 4


@dataclass(frozen=True)
class Surface:
    """A lit scene: per vertex what the shading of a sample interpolates."""

    scene: TexturedMesh
    irradiance: Float[Tensor, "vertex 3"]
    lights: Lights
    pyramid: TexturePyramid


def light(scene: TexturedMesh, lights: Lights, pyramid: TexturePyramid) -> Surface:
    """Light a scene once, for any number of cameras; all arguments on one device.

    Args:
        scene: the performers at one time.
        lights: of the stage.
        pyramid: `texture_pyramid(scene.textures)`.
    """
    return Surface(scene, irradiance(scene.mesh, scene.normals, lights), lights, pyramid)


def render(
    surface: Surface,
    cameras: Cameras,
    background: Float[Tensor, "view 3 height width"] | None = None,
    samples_per_side: int = 2,
) -> MultiViewFrame:
    """Draw a lit scene into every camera, as the frame of time 0.

    Each pixel is shaded at samples_per_side x samples_per_side points, which gives its colour and coverage; the depth
    is that of its centre. On the CPU numba shades, elsewhere torch does.

    Args:
        surface: what `light` made.
        cameras: on the surface's device.
        background: what stands behind, linear light; black if None.
        samples_per_side: 2 gives masks in steps of a quarter.
    """
    if samples_per_side < 1:
        raise ValueError(f"expected samples_per_side of at least 1, got {samples_per_side}; 2 is usual")
    fine = replace(
        cameras,
        K=cameras.K * torch.tensor([samples_per_side, samples_per_side, 1.0], device=cameras.K.device)[:, None],
        size_px=cameras.size_px * samples_per_side,
    )
    mesh = surface.scene.mesh
    triangle = rasterize(mesh, fine).triangle
    depth = rasterize(mesh, cameras).depth
    if background is None:
        background = torch.zeros(len(cameras), 3, *depth.shape[1:], device=depth.device)
    if depth.device.type == "cpu":
        return MultiViewFrame(cameras, *_shade_cpu(surface, fine, triangle, background), 0, depth)
    return MultiViewFrame(cameras, *shade_torch(surface, fine, triangle, background), 0, depth)


def shade_torch(
    surface: Surface,
    fine: Cameras,
    triangle: Int[Tensor, "view fine_height fine_width"],
    background: Float[Tensor, "view 3 height width"],
) -> tuple[UInt8[Tensor, "view 3 height width"], UInt8[Tensor, "view height width"]]:
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


def _sample_colors(
    surface: Surface, camera: Cameras, triangle: Int[Tensor, "1 fine_height fine_width"]
) -> Float[Tensor, "sample 3"]:
    """Linear light of the covered samples of one view."""
    scene, lights = surface.scene, surface.lights
    levels = face_levels(scene, camera, surface.pyramid)[0]
    weights = barycentric(scene.mesh, camera, Raster(torch.zeros(triangle.shape, device=levels.device), triangle))
    face = triangle[triangle >= 0].long()
    weights = weights[triangle >= 0][:, :, None]
    corners = scene.mesh.faces.long()[face]
    uv, normal, lit, place = (
        (values[corners] * weights).sum(1)
        for values in (scene.uv, scene.normals, surface.irradiance, scene.mesh.vertices)
    )
    albedo = sample_texture(surface.pyramid, scene.texture_of_face.long()[face], uv, levels[face])
    return albedo * lit + lit * _highlight(normal, camera.centers[0] - place, lights)


def _highlight(
    normal: Float[Tensor, "sample 3"], toward_camera: Float[Tensor, "sample 3"], lights: Lights
) -> Float[Tensor, "sample 3"]:
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


def _shade_cpu(
    surface: Surface,
    fine: Cameras,
    triangle: Int[Tensor, "view fine_height fine_width"],
    background: Float[Tensor, "view 3 height width"],
) -> tuple[UInt8[Tensor, "view 3 height width"], UInt8[Tensor, "view height width"]]:
    """`shade_torch` by numba: bands of rows, shared among threads."""
    scene, lights, pyramid = surface.scene, surface.lights, surface.pyramid
    views, _, height, width = background.shape
    P = fine.K.double() @ fine.camera_from_world[:, :3].double()
    projected = scene.mesh.vertices.double() @ P[:, :, :3].mT + P[:, None, :, 3]
    vertex = torch.cat([scene.mesh.vertices, scene.uv, scene.normals, surface.irradiance], 1).float()
    parts = (vertex, scene.mesh.faces, scene.texture_of_face, pyramid.texels, pyramid.first, pyramid.size)
    arrays = [t.contiguous().numpy() for t in (*parts, lights.lamps, lights.gloss)]
    shared = kernels.Scene._make((*arrays, GLOSS_DOUBLINGS, *kernels.encoding()))
    seen = [t.contiguous().numpy() for t in (triangle, projected, fine.centers, background)]
    rgb = torch.zeros(views, 3, height, width, dtype=torch.uint8)
    mask = torch.zeros(views, height, width, dtype=torch.uint8)
    colors, covers = rgb.numpy(), mask.numpy()

    def draw(item: int) -> None:
        v, band = divmod(item, BANDS)
        rows = (height * band // BANDS, height * (band + 1) // BANDS)
        kernels.shade_band(shared, kernels.View(*(a[v] for a in seen)), *rows, colors[v], covers[v])

    parallel_for(draw, views * BANDS)
    return rgb, mask
