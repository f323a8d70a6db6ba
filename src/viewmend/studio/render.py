"""Draws the stage into cameras: anti-aliased colour, soft mask, exact depth."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d

from viewmend.geometry.cameras import Cameras, concatenate_cameras, pinhole, pixel_centers, project
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import rasterize
from viewmend.geometry.rigid import look_at
from viewmend.geometry.threads import parallel_for
from viewmend.studio import _shade_numba as kernels
from viewmend.studio.performer import TexturedMesh, TexturePyramid
from viewmend.types import MultiViewFrame

_WALLS = ((0.05, 0.35, 0.08), (0.22, 0.22, 0.23), (0.04, 0.04, 0.05), (0.6, 0.6, 0.58), (0.06, 0.12, 0.4))
"""Colours of backdrops in linear light: green screen, grey, dark, white, blue screen."""
DIRECTIONS = 16
"""Number of directions in which the light of the surroundings is sampled."""
EVENNESS = 0.65
"""Fraction of the light that comes from the surroundings; the rest is from lamps."""
SHADOW_PX = 128
"""Height and width of shadow maps, pixels."""
SHADOW_DISTANCE_M = 12.0
"""Distance of the lights, metres: near enough for a pinhole camera, far enough to look parallel."""
SHADOW_BIAS_M = 0.015
GLOSS_DOUBLINGS = 4
"""Highlights fall off with the power 2^this of the half vector's cosine: a power that needs no logarithm."""
BANDS = 4
"""Number of bands of rows that threads share."""


@dataclass(frozen=True)
class Lights:
    """Light from a sphere of directions (diffuse, with shadows), and lamps that make highlights. Linear light."""

    toward: Float[Tensor, "light 3"]
    """Unit vectors from the stage to each direction."""
    strength: Float[Tensor, "light 3"]
    """Light that a white surface facing the direction reflects of it."""
    lamps: Float[Tensor, "lamp 3"]
    """Unit vectors to the lamps."""
    gloss: Float[Tensor, "lamp 3"]
    """Colour at the middle of each lamp's highlight."""


def stage_lights(seed: int) -> Lights:
    """Sample the lights of a capture stage: nearly the same from all sides.

    A surrounding that is brighter above than below gives the share `EVENNESS`; three large soft
    lamps of slightly different strength and tint, around and above, give the rest.
    """
    generator = torch.Generator().manual_seed(seed)
    # Directions spread evenly over a sphere (a Fibonacci spiral).
    place = torch.arange(DIRECTIONS) + 0.5
    y = 1 - 2 * place / DIRECTIONS
    around = place * math.pi * (3 - math.sqrt(5))
    radius = (1 - y * y).sqrt()
    toward = torch.stack([radius * around.cos(), y, radius * around.sin()], -1)
    surrounding = (0.75 + 0.45 * toward[:, 1:2]).expand(-1, 3)
    angle = torch.rand((), generator=generator) * 2 * math.pi + torch.arange(3) * 2 * math.pi / 3
    angle = angle + 0.5 * torch.rand(3, generator=generator)
    height = 0.4 + 0.7 * torch.rand(3, generator=generator)
    lamps = torch.nn.functional.normalize(torch.stack([angle.cos(), height, angle.sin()], -1), dim=-1)
    tint = 1 + 0.08 * (2 * torch.rand(3, 3, generator=generator) - 1)
    power = (0.5 + torch.rand(3, 1, generator=generator)) * tint
    lobes = torch.exp(6 * (toward @ lamps.T - 1)) @ power
    # A white wall of any heading reflects the same on average, whatever the seed: exposure is the
    # camera's matter.
    heading = torch.arange(16) * math.pi / 8
    walls = torch.stack([heading.cos(), torch.zeros(16), heading.sin()], -1)
    facing = (walls @ toward.T).clamp(min=0)
    parts = [
        share * part / (facing @ part).mean()
        for share, part in ((EVENNESS, surrounding), (1 - EVENNESS, lobes))
    ]
    return Lights(toward, 0.95 * (parts[0] + parts[1]), lamps, 0.05 * power)


def visibility(
    mesh: Mesh, normals: Float[Tensor, "vertex 3"], lights: Lights
) -> Float[Tensor, "vertex light"]:
    """Compute the fraction of each direction that the mesh leaves visible at its vertices, 0 to 1.

    One small shadow map per direction; together they are soft shadows and ambient occlusion at once.
    """
    # A far camera at each light that holds the whole mesh.
    low = mesh.vertices.amin(0)
    high = mesh.vertices.amax(0)
    middle = (low + high) / 2
    radius = float((high - low).norm()) / 2 + 0.02
    distance = SHADOW_DISTANCE_M + radius
    up, side = torch.tensor([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]], device=middle.device)
    poses = [
        look_at(middle + toward * distance, middle, side if float((toward @ up).abs()) > 0.99 else up)
        for toward in lights.toward
    ]
    fov = 2 * math.asin(radius / distance)
    cameras = concatenate_cameras([pinhole(fov, SHADOW_PX, SHADOW_PX, pose) for pose in poses])
    depth = rasterize(mesh, cameras).depth
    depth = torch.where(depth > 0, depth, torch.full_like(depth, torch.inf))
    pixels, z = project(mesh.vertices + SHADOW_BIAS_M * normals, cameras)
    seen = torch.empty_like(z)

    def look(n: int) -> None:
        kernels.shadow_visibility(
            pixels[n].numpy(), z[n].numpy(), depth[n].numpy(), SHADOW_BIAS_M, seen[n].numpy()
        )

    parallel_for(look, len(cameras))
    return seen.T


def stage_backdrop(cameras: Cameras, seed: int) -> Float[Tensor, "view 3 height width"]:
    """Draw the backdrop of each camera's image in linear light: a wall that darkens downwards into a floor.

    The colours are seeded and depend on the elevation of a ray only, so that all cameras agree on a
    distant backdrop.
    """
    generator = torch.Generator().manual_seed(seed)
    wall = torch.tensor(_WALLS[int(torch.randint(len(_WALLS), (), generator=generator))])
    floor = wall * (0.5 + 0.6 * float(torch.rand((), generator=generator)))
    width, height = cameras.max_size_px
    pixels = pixel_centers(width, height, cameras.K.device).flatten(0, 1)
    pixels = torch.cat([pixels, torch.ones_like(pixels[:, :1])], -1)
    up_from_pixel = cameras.camera_from_world[:, :3, 1:2].mT @ torch.linalg.inv(cameras.K)
    rays = torch.linalg.inv(cameras.K) @ pixels.T
    upward = (up_from_pixel @ pixels.T)[:, 0] / rays.norm(dim=1)
    share = torch.sigmoid((upward + 0.15) * 12)[:, None]
    wall, floor = (c.to(pixels)[None, :, None] for c in (wall, floor))
    return ((floor + (wall - floor) * share) * (0.9 + 0.2 * upward[:, None])).unflatten(-1, (height, width))


@dataclass(frozen=True)
class Surface:
    """A lit scene: the vertex attributes that shading interpolates."""

    scene: TexturedMesh
    irradiance: Float[Tensor, "vertex 3"]
    lights: Lights
    pyramid: TexturePyramid


def light(scene: TexturedMesh, lights: Lights, pyramid: TexturePyramid) -> Surface:
    """Light a scene once, for any number of cameras."""
    facing = (scene.normals @ lights.toward.T).clamp(min=0)
    irradiance = (facing * visibility(scene.mesh, scene.normals, lights)) @ lights.strength
    return Surface(scene, irradiance, lights, pyramid)


def render(
    surface: Surface,
    cameras: Cameras,
    background: Float[Tensor, "view 3 height width"] | None = None,
    samples_per_side: int = 2,
) -> MultiViewFrame:
    """Draw a lit scene into every camera, as the frame of time 0.

    Each pixel is shaded at samples_per_side x samples_per_side points, which gives its colour and
    coverage; the depth is that of its centre. All arguments are on the CPU.

    Args:
        surface: what `light` made.
        cameras: of any sizes.
        background: what stands behind, linear light; black if None.
        samples_per_side: 2 gives masks in steps of a quarter.
    """
    fine = _sample_cameras(cameras, samples_per_side)
    scene = surface.scene
    lights = surface.lights
    pyramid = surface.pyramid
    triangle = rasterize(scene.mesh, fine).triangle
    depth = rasterize(scene.mesh, cameras).depth
    if background is None:
        background = torch.zeros(len(cameras), 3, *depth.shape[1:])
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
    colors = rgb.numpy()
    covers = mask.numpy()

    def draw(item: int) -> None:
        v, band = divmod(item, BANDS)
        rows = (height * band // BANDS, height * (band + 1) // BANDS)
        kernels.shade_band(shared, kernels.View(*(a[v] for a in seen)), *rows, colors[v], covers[v])

    parallel_for(draw, views * BANDS)
    return MultiViewFrame(cameras, rgb, mask, 0, depth)


def render_masks(
    mesh: Mesh, cameras: Cameras, samples_per_side: int = 2
) -> UInt8[Tensor, "view height width"]:
    """Draw the masks of `render` alone, without shading."""
    covered = rasterize(mesh, _sample_cameras(cameras, samples_per_side)).triangle >= 0
    share = avg_pool2d(covered[:, None].float(), samples_per_side)[:, 0]
    return (255 * share).round().to(torch.uint8)


def _sample_cameras(cameras: Cameras, samples_per_side: int) -> Cameras:
    """Cameras with one pixel for each sample."""
    if samples_per_side < 1:
        raise ValueError(f"expected samples_per_side of at least 1, got {samples_per_side}; 2 is usual")
    K = cameras.K * torch.tensor([samples_per_side, samples_per_side, 1.0])[:, None]
    return replace(cameras, K=K, size_px=cameras.size_px * samples_per_side)
