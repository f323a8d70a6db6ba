import torch
from reference import ball
from reference.shading_reference import shade, unshadowed
from studio.tiny_performer import write_motion

from viewmend.geometry.cameras import Cameras, concatenate_cameras, pinhole
from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.geometry.rasterize import rasterize
from viewmend.geometry.rigid import look_at
from viewmend.studio import _shade_numba
from viewmend.studio.gltf_performer import GltfPerformer
from viewmend.studio.performer import TexturedMesh, texture_pyramid
from viewmend.studio.render import SHADOW_BIAS_M, Lights, Surface, light, render, stage_lights, visibility
from viewmend.studio.rigs import orbit, ring_rig


def sphere(radius: float, center=(0.0, 0.95, 0.0)) -> TexturedMesh:
    mesh = ball.proxy(40).mesh
    normals = mesh.vertices / ball.RADIUS_M
    around, polar = torch.atan2(normals[:, 0], normals[:, 2]), normals[:, 1].clamp(-1, 1).acos()
    uv = torch.stack([around / (2 * torch.pi) + 0.5, polar / torch.pi], -1)
    texture = torch.rand(3, 32, 64, generator=torch.Generator().manual_seed(3))
    whole = Mesh(radius * normals + torch.tensor(center), mesh.faces)
    return TexturedMesh(whole, normals, uv, torch.zeros(len(mesh.faces), dtype=torch.long), (texture,))


def lit(scene: TexturedMesh) -> Surface:
    return light(scene, stage_lights(0), texture_pyramid(scene.textures))


def test_textures_are_upright_and_not_mirrored():
    texture = torch.zeros(3, 16, 16)
    texture[0, :8, :8] = 1  # red at the top left
    texture[1, :8, 8:] = 1  # green at the top right
    texture[2, 8:] = 1  # blue below
    # A square of one metre that faces +z.
    uv = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    corners = torch.cat([uv[:, :1] - 0.5, 1.45 - uv[:, 1:], torch.zeros(4, 1)], 1)
    mesh = Mesh(corners, torch.tensor([[0, 2, 1], [0, 3, 2]]))
    square = TexturedMesh(mesh, vertex_normals(mesh), uv, torch.zeros(2, dtype=torch.long), (texture,))
    rgb = render(lit(square), orbit([0.0], (64, 64), elevation_rad=0.0)).rgb[0]
    for row, column, channel in ((24, 24, 0), (24, 40, 1), (40, 24, 2), (40, 40, 2)):
        assert int(rgb[:, row, column].argmax()) == channel and int(rgb[channel, row, column]) > 100


def test_the_left_hand_is_at_the_images_right(character_file, tmp_path):
    """Seen from the front, the character's left (red) is at the right side of the image, and its head on top."""
    performer = GltfPerformer(character_file, write_motion(tmp_path / "still.bvh"), seed=1)
    performer._stage_from_motion = torch.eye(3)
    rgb = render(lit(performer.pose(0.0)), orbit([0.0], (96, 96), elevation_rad=0.0)).rgb[0].int()
    columns = torch.arange(96).float()
    red, green = ((rgb[a] - rgb[b]).clamp(min=0).float() for a, b in ((0, 1), (1, 0)))
    assert (
        float((red.sum(0) * columns).sum() / red.sum())
        > float((green.sum(0) * columns).sum() / green.sum()) + 10
    )
    top = int((rgb.sum(0) > 0).any(1).nonzero()[0])
    assert int(green[top].sum()) > 0 and top < 30


def test_shading_is_that_of_the_reference():
    scene = sphere(0.6)
    near = look_at(
        torch.tensor([0.8, 1.2, 0.4]), torch.tensor([0.0, 0.95, 0.0]), torch.tensor([0.0, 1.0, 0.0])
    )
    cameras = concatenate_cameras([ring_rig(2, (60, 44), seed=2), pinhole(1.0, 50, 48, near, "near")])
    surface = lit(scene)
    background = torch.rand(3, 3, 48, 60, generator=torch.Generator().manual_seed(1))
    fast = render(surface, cameras, background)
    K = cameras.K * torch.tensor([2.0, 2.0, 1.0])[:, None]
    fine = Cameras(cameras.names, K, cameras.camera_from_world, cameras.size_px * 2)
    rgb, mask = shade(surface, fine, rasterize(scene.mesh, fine).triangle, background)
    assert torch.equal(mask, fast.mask)
    # Rounding to 8 bit may fall to either side.
    assert int((rgb.int() - fast.rgb.int()).abs().max()) <= 1
    assert float((rgb != fast.rgb).float().mean()) < 1e-3


def test_shadow_lookups_agree():
    generator = torch.Generator().manual_seed(0)
    scene, lights = sphere(0.4), stage_lights(0)
    fast = visibility(scene.mesh, scene.normals, lights)
    facing = scene.normals @ lights.toward.T
    assert float(fast[facing > 0.2].min()) > 0.99, "a convex body does not shade what faces the light"
    assert float(fast[facing < -0.4].max()) < 0.5, "what faces away is in its own shadow"
    pixels = 140 * torch.rand(2, 500, 2, generator=generator) - 6
    z, depth = torch.rand(2, 500, generator=generator), torch.rand(2, 128, 128, generator=generator)
    slow, seen = unshadowed(pixels, z, depth), torch.zeros(2, 500)
    for n in range(2):
        arrays = (pixels[n].numpy(), z[n].numpy(), depth[n].numpy(), SHADOW_BIAS_M, seen[n].numpy())
        _shade_numba.shadow_visibility(*arrays)
    torch.testing.assert_close(seen, slow, atol=1e-5, rtol=0)


def test_a_roof_shades_what_is_under_it():
    ball = sphere(0.2, (0.0, 0.5, 0.0))
    roof = sphere(0.5, (0.0, 1.5, 0.0))
    vertices = torch.cat([ball.mesh.vertices, roof.mesh.vertices])
    faces = torch.cat([ball.mesh.faces, roof.mesh.faces + len(ball.mesh.vertices)])
    up = Lights(torch.tensor([[0.0, 1, 0]]), torch.ones(1, 3), torch.zeros(0, 3), torch.zeros(0, 3))
    both = visibility(Mesh(vertices, faces), torch.cat([ball.normals, roof.normals]), up)[: len(ball.normals)]
    alone = visibility(ball.mesh, ball.normals, up)
    top = ball.normals[:, 1] > 0.5
    assert float(both[top].max()) == 0 and float(alone[top].min()) > 0.99
