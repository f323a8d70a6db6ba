import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from viewmend.studio.performer import Performer, TexturedMesh
from viewmend.studio.procedural import PerformerStyle, procedural_scene
from viewmend.studio.procedural.fabric import KINDS, Canvas, sample_fabric
from viewmend.studio.procedural.head import build_head
from viewmend.studio.procedural.motion import MOTIONS, Tempo, sample_motion
from viewmend.studio.procedural.skeleton import sample_physique

SEED = 10_000
WALKER = PerformerStyle(tempo="calm", motion="walk", people=1, holding=False, furniture=False)
KIND_OF_TEMPO = [(tempo, kind) for tempo, kinds in MOTIONS.items() for kind in kinds]


@pytest.fixture(scope="module")
def walker():
    return procedural_scene(SEED, style=WALKER)


def tensors(scene: TexturedMesh):
    return (
        scene.mesh.vertices,
        scene.mesh.faces,
        scene.normals,
        scene.uv,
        scene.texture_of_face,
        *scene.textures,
    )


def test_the_same_seed_is_the_same_bit_for_bit(walker):
    again = procedural_scene(SEED, style=WALKER)
    assert again.description == walker.description
    assert all(
        torch.equal(a, b) for a, b in zip(tensors(again.pose(1.3)), tensors(walker.pose(1.3)), strict=True)
    )


@pytest.mark.parametrize("seed", [SEED, SEED + 1, SEED + 2])
def test_a_scene_is_a_whole_and_valid_mesh(seed):
    cast: Performer = procedural_scene(seed)
    scene = cast.pose(0.4)
    vertices, faces = scene.mesh.vertices, scene.mesh.faces
    assert all(torch.isfinite(t).all() for t in tensors(scene))
    assert vertices.dtype == torch.float32
    assert torch.equal(torch.unique(faces), torch.arange(len(vertices)))
    assert float(scene.uv.min()) >= 0 and float(scene.uv.max()) <= 1
    torch.testing.assert_close(scene.normals.norm(dim=1), torch.ones(len(vertices)), atol=1e-4, rtol=0)
    assert set(scene.texture_of_face.tolist()) == set(range(len(scene.textures)))
    assert all(float(t.min()) >= 0 and float(t.max()) <= 1 for t in scene.textures)
    assert float(vertices[:, [0, 2]].norm(dim=1).max()) < 1.5


def test_the_size_is_human(walker):
    person = walker.people[0]
    bind = person.bound.rest.mesh.vertices
    tall = float(bind[:, 1].max() - bind[:, 1].min())
    assert tall == pytest.approx(person.physique.height_m, rel=0.05)
    # An A-pose: the finger tips are less far out than in a T-pose (half the height).
    assert 0.34 < float(bind[:, 0].max()) / tall < 0.46
    # Seven and a half heads: the chin is where anatomy has it.
    head = build_head(person.physique, person.skeleton)
    chin, crown = head.point(np.zeros(2), np.array([0.0, 1.0]))[:, 1] / person.physique.height_m
    assert crown == pytest.approx(1.0, abs=1e-6)
    assert 7.0 < 1 / (crown - chin) < 8.0
    for seed in range(200):
        assert 1.5 <= sample_physique(np.random.default_rng(seed)).height_m <= 1.95


def test_normals_point_outward(walker):
    scene = walker.pose(0.0)
    a, b, c = scene.mesh.vertices[scene.mesh.faces].unbind(1)
    across = torch.linalg.cross(b - a, c - a)
    volume = (a * across).sum() / 6
    assert 0.03 < float(volume) < 0.3
    agree = (across * scene.normals[scene.mesh.faces[:, 0]]).sum(1) > 0
    assert float(agree.float().mean()) > 0.97


def moving(walker, tempo: Tempo, kind: str):
    """The walker in another motion, without drawing the body again."""
    person, rng = walker.people[0], np.random.default_rng(SEED)
    return replace(person, motion=sample_motion(rng, person.physique, person.skeleton, tempo, kind, 0.1))


@pytest.mark.parametrize(("tempo", "kind"), KIND_OF_TEMPO)
def test_motion_is_smooth_and_stays_on_the_floor(walker, tempo, kind):
    person, times = moving(walker, tempo, kind), 0.2 + np.arange(4) / 40
    poses = [person.pose(float(time)).mesh.vertices for time in times]
    lowest = torch.stack([vertices[:, 1].min() for vertices in poses])
    velocity = torch.stack([b - a for a, b in itertools.pairwise(poses)]) * 40
    assert float(velocity.norm(dim=-1).max()) < 12.0
    # A jump of ten centimetres in one frame is a change of 3 m/s or more.
    assert float(velocity.diff(dim=0).norm(dim=-1).max()) < 4
    assert float(lowest.min()) > -0.01
    assert float(lowest.max()) < (0.2 if kind in ("run", "jacks") else 0.01)


@pytest.mark.parametrize("kind", ["groove", "walk", "sit"])
def test_gestures_take_turns_without_a_jump(walker, kind):
    motion = moving(walker, "dance", kind).motion
    times = np.arange(0, 2 * motion.bar_s, 1 / 50)
    arms = [arm for time in times for arm in motion.stance(float(time)).arms]
    angles = np.array([(a.flexion, a.abduction, a.twist, a.elbow, a.curl) for a in arms]).reshape(
        len(times), 10
    )
    assert np.abs(np.diff(angles, axis=0)).max() < 0.35


def test_a_sitter_rests_on_a_stool():
    cast = procedural_scene(SEED, style=PerformerStyle(tempo="calm", motion="sit", people=1, furniture=False))
    assert cast.things is not None
    floor, seat = cast.things.mesh.vertices[:, 1].aminmax()
    assert 0.35 < float(seat) < 0.55 and float(floor) == pytest.approx(0.0, abs=1e-6)


def test_two_people_and_things():
    style = PerformerStyle(people=2, furniture=True, holding=True, tempo="calm", motion="talk")
    cast = procedural_scene(SEED, style=style)
    assert len(cast.people) == 2 and cast.things is not None
    scene = cast.pose(0.0)
    assert len(scene.textures) == 3
    assert len(torch.unique(scene.mesh.faces)) == len(scene.mesh.vertices)
    assert "with a" in cast.description and "next to" in cast.description


@pytest.mark.parametrize("kind", KINDS)
def test_each_cloth_paints_colours_that_vary(kind):
    image = sample_fabric(np.random.default_rng(3), (kind,)).paint(Canvas(0.6, 0.5, 200.0))
    assert image.shape == (100, 120, 3) and image.min() >= 0 and image.max() <= 1 and image.std() > 0.004


@pytest.mark.parametrize(
    "style, message", [({"motion": "moonwalk"}, "moonwalk"), ({"people": 7}, "1 or 2 people")]
)
def test_unknown_styles_are_refused(style, message):
    with pytest.raises(ValueError, match=message):
        procedural_scene(SEED, style=PerformerStyle(**style))
