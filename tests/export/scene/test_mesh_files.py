"""What is written is what other programs read."""

import numpy as np
import pytest
import torch
import trimesh
from reference.ball import RADIUS_M, photograph, proxy, ring

from viewmend.export.mesh_files import write_glb, write_ply
from viewmend.rendering.proxy_views import vertex_colours
from viewmend.types import ContextViews

BALL = proxy(24)
COLOURS = 0.5 + 0.4 * BALL.mesh.vertices / RADIUS_M
EVERY_COLOUR = 0.5 + 0.5 * BALL.mesh.vertices / RADIUS_M  # from black to white


def load(path):
    return trimesh.load(path, process=False, force="mesh")


def of_file(read, accessor, kind, columns):
    view = read.bufferViews[accessor.bufferView]
    return np.frombuffer(read.binary_blob()[view.byteOffset :][: view.byteLength], kind).reshape(-1, columns)


def test_the_glb_keeps_to_the_specification(tmp_path):
    from pygltflib import GLTF2

    write_glb(tmp_path / "ball.glb", BALL.mesh.vertices, BALL.mesh.faces, EVERY_COLOUR, BALL.normals)
    data = (tmp_path / "ball.glb").read_bytes()
    read = GLTF2.load_from_bytes(data)
    assert int.from_bytes(data[8:12], "little") == len(data) and len(data) % 4 == 0
    assert read.extensionsUsed == ["KHR_materials_unlit"] == list(read.materials[0].extensions)
    position, normal, colour = read.accessors[:3]
    assert (of_file(read, normal, "<f4", 3) == BALL.normals.numpy()).all()
    linear = of_file(read, colour, "<u2", 4)[:, :3] / 65535
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert np.abs(srgb - EVERY_COLOUR.numpy()).max() < 2e-4
    assert position.min == pytest.approx([-RADIUS_M] * 3, abs=0.01) and colour.normalized
    assert all(view.byteOffset % 4 == 0 for view in read.bufferViews)
    assert read.buffers[0].byteLength == sum(view.byteLength for view in read.bufferViews)


def test_nothing_is_a_scene_without_a_mesh(tmp_path):
    none = torch.zeros(0, 3)
    write_glb(tmp_path / "none.glb", none, none.int(), none, none)
    assert len(trimesh.load(tmp_path / "none.glb").geometry) == 0


def test_a_ply_holds_mesh_or_points(tmp_path):
    write_ply(tmp_path / "mesh.ply", BALL.mesh.vertices, COLOURS, BALL.mesh.faces)
    write_ply(tmp_path / "points.ply", BALL.mesh.vertices, COLOURS)
    mesh, points = load(tmp_path / "mesh.ply"), trimesh.load(tmp_path / "points.ply", process=False)
    assert (mesh.faces == BALL.mesh.faces.numpy()).all() and isinstance(points, trimesh.PointCloud)
    for read, colours in ((mesh, mesh.visual.vertex_colors), (points, points.colors)):
        assert np.abs(read.vertices - BALL.mesh.vertices.numpy()).max() < 1e-6
        assert np.abs(colours[:, :3] / 255 - COLOURS.numpy()).max() < 0.5 / 255 + 1e-6


def seen_by(cameras):
    return ContextViews(photograph(cameras), BALL.depth(cameras))


def test_a_hidden_side_is_not_coloured_through_the_body():
    found = vertex_colours(BALL, seen_by(ring(1, 96)))  # one camera, at +z
    front, back = BALL.mesh.vertices[:, 2] > 0.5 * RADIUS_M, BALL.mesh.vertices[:, 2] < -0.1
    assert float((found - COLOURS)[front].abs().max()) < 0.04
    assert float(found[back, 2].min()) > 0.4  # the rim's blue; the far side's own would be below 0.4


def test_unseen_meshes_are_grey():
    away = seen_by(ring(1, 96))
    assert bool((vertex_colours(BALL, ContextViews(away.frame, torch.zeros_like(away.depth))) == 0.5).all())
