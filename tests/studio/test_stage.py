import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from studio.tiny_performer import write_character, write_motion

from viewmend.data.errors import CaptureError
from viewmend.geometry.cameras import project
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rigid import is_rotation, rigid, rotation_from_axis_angle
from viewmend.studio import stage
from viewmend.studio.gltf_performer import GltfPerformer
from viewmend.studio.imperfections import Imperfections
from viewmend.studio.performer import BoundMesh, TexturedMesh
from viewmend.studio.render import Surface
from viewmend.studio.rigs import dome_rig, orbit, ring_rig
from viewmend.studio.stage import Studio, StudioConfig


@pytest.fixture
def folders(tmp_path):
    """Two characters and two motions to pick from."""
    (tmp_path / "people").mkdir()
    (tmp_path / "moves").mkdir()
    for name in ("a", "b"):
        write_character(tmp_path / "people" / f"{name}.glb")
        write_motion(
            tmp_path / "moves" / f"{name}.bvh", {"LeftShoulder": (70, 0, 0), "Hips": (0, 0, 40)}, frames=30
        )
    return {"performers": tmp_path / "people", "motions": tmp_path / "moves"}


def config(folders, **changes) -> StudioConfig:
    return StudioConfig(**{"seed": 3, "cameras": 4, "frames": 5, "size_px": 48} | folders | changes)


def test_frames_are_what_the_capture_says(folders):
    studio = Studio(config(folders, size_px=(64, 48)))
    frame = studio.read(2)
    assert studio.frame_ids == tuple(f"{n:06d}" for n in range(5)) and studio.fps == 30.0
    assert frame.time == 2 and frame.cameras.names == studio.cameras.names
    assert frame.rgb.shape == (4, 3, 48, 64) and frame.rgb.dtype == torch.uint8
    assert frame.mask is not None and frame.depth is not None
    assert 0.02 < float((frame.mask > 127).float().mean()) < 0.5
    seen = frame.depth > 0
    assert float(((frame.mask > 0) != seen).float().mean()) < 0.05
    assert float(frame.depth[seen].min()) > 1.5 and float(frame.depth.max()) < 5
    assert int(frame.rgb.permute(0, 2, 3, 1)[frame.mask == 0].sum()) == 0


def test_the_same_seed_gives_the_same_capture_in_any_order(folders):
    wrong = Imperfections.typical()
    a, b = (Studio(config(folders, imperfections=wrong, background="stage")) for _ in range(2))
    b.truth(orbit([0.3], (32, 32)), 1)
    frames = {t: b.read(t) for t in (4, 0, 2)}
    for t in (0, 2, 4):
        x, y = a.read(t), frames[t]
        assert torch.equal(x.rgb, y.rgb) and torch.equal(x.mask, y.mask) and torch.equal(x.depth, y.depth)
    assert torch.equal(a.cameras.camera_from_world, b.cameras.camera_from_world)
    other = Studio(config(folders, seed=4, imperfections=wrong, background="stage"))
    assert not torch.equal(a.read(0).rgb, other.read(0).rgb)


def test_the_truth_of_an_input_camera_is_its_image(folders):
    studio = Studio(config(folders))
    frame, truth = studio.read(1), studio.truth(studio.cameras[2], 1)
    assert torch.equal(truth.mask[0], frame.mask[2]) and torch.equal(truth.depth[0], frame.depth[2])
    inside = frame.mask[2] == 255
    assert torch.equal(truth.rgb[0][:, inside], frame.rgb[2][:, inside])


def test_the_truth_is_not_darkened_at_outlines(folders):
    truth = Studio(config(folders)).truth(orbit([0.3], (96, 96)), 0)
    edge = (truth.mask[0] > 0) & (truth.mask[0] < 255)
    inside = truth.mask[0] == 255
    levels = [float(truth.rgb[0].float().mean(0)[where].mean()) for where in (edge, inside)]
    assert abs(levels[0] - levels[1]) < 0.25 * levels[1]


def test_truth_on_stage_differs_from_that_on_black_only_where_the_mask_is_soft():
    studio = Studio(StudioConfig(seed=3, cameras=2, frames=1, size_px=64, background="stage"))
    alone, staged = (studio.truth(studio.cameras, 0, on_stage=on) for on in (False, True))
    assert alone.mask is not None and staged.mask is not None and torch.equal(alone.mask, staged.mask)
    other = (alone.rgb.int() - staged.rgb.int()).abs().amax(1) > 2
    assert bool(other[alone.mask == 0].all()) and not bool(other[alone.mask == 255].any())
    soft = (alone.mask > 0) & (alone.mask < 255)
    assert bool(other[soft].float().mean() > 0.5)


def test_imperfections_leave_the_truth_alone(folders):
    plain, wrong = Studio(config(folders)), Studio(config(folders, imperfections=Imperfections.typical()))
    view = orbit([1.0], (40, 40))
    assert torch.equal(plain.truth(view, 3).rgb, wrong.truth(view, 3).rgb)
    assert not torch.equal(plain.read(3).rgb, wrong.read(3).rgb)
    assert torch.equal(plain.read(3).depth, wrong.read(3).depth)
    assert not torch.equal(plain.cameras.camera_from_world, wrong.cameras.camera_from_world)
    assert torch.equal(plain.cameras.camera_from_world, wrong.true_cameras.camera_from_world)


def test_a_stage_stands_behind_the_subject_in_images_alone(folders):
    studio = Studio(config(folders, background="stage"))
    frame = studio.read(0)
    outside = frame.mask == 0
    assert int(frame.rgb.permute(0, 2, 3, 1)[outside].amax(-1).min()) > 5
    assert int(studio.truth(studio.cameras, 0).rgb.permute(0, 2, 3, 1)[outside].sum()) == 0


def test_bounds_hold_the_performer_and_up_is_up(folders):
    studio = Studio(config(folders))
    assert studio.bounds is not None
    for t in range(5):
        vertices = studio.scene(t).mesh.vertices
        assert bool(((vertices > studio.bounds.low) & (vertices < studio.bounds.high)).all())
    assert float(studio.bounds.size_m.max()) < 3
    assert studio.up.tolist() == [0, 1, 0]


def test_a_rig_may_be_given(folders):
    ring = ring_rig(3, (40, 30), seed=5)
    studio = Studio(config(folders, cameras=ring))
    assert torch.equal(studio.cameras.camera_from_world, ring.camera_from_world)
    assert studio.read(0).rgb.shape == (3, 3, 30, 40)
    assert len(Studio(config(folders, cameras=6, rig="dome")).cameras) == 6


def test_picks_are_seeded_and_a_file_is_taken_as_it_is(folders):
    names = {Studio(config(folders, seed=s)).performer.description for s in range(8)}
    assert len(names) > 1
    one = config(folders, performers=folders["performers"] / "b.glb", motions=folders["motions"] / "a.bvh")
    assert Studio(one).performer.description == "b doing a"


def test_a_time_outside_the_capture(folders):
    for time in (-1, 5):
        with pytest.raises(IndexError, match="0 to 4"):
            Studio(config(folders)).read(time)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"performers": None}, "no performers"),
        ({"motions": None}, "no motions"),
        ({"frames": 0}, "at least one frame"),
        ({"size_px": (0, 4)}, "positive rate and size"),
        ({"cameras": 0}, "at least 1 camera"),
    ],
)
def test_bad_configs_say_what_is_wrong(folders, changes, message):
    with pytest.raises(ValueError, match=message):
        Studio(config(folders, **changes))


def test_empty_and_missing_folders_are_named(folders, tmp_path):
    shutil.rmtree(folders["motions"])
    with pytest.raises(CaptureError, match=r"moves.*no such folder"):
        Studio(config(folders))
    folders["motions"].mkdir()
    with pytest.raises(CaptureError, match=r"moves.*no such files"):
        Studio(config(folders))


def test_depth_and_cameras_agree_with_the_surface(folders):
    """Vertices that a camera sees have the depth that its image says."""
    studio = Studio(config(folders, size_px=200))
    frame, vertices = studio.read(0), studio.scene(0).mesh.vertices
    uv, z = project(vertices, frame.cameras)
    for view in range(4):
        column, row = (uv[view] - 0.5).round().long().clamp(0, 199).unbind(1)
        depth = frame.depth[view, row, column]
        near = (depth > 0) & ((z[view] - depth).abs() < 0.03)
        assert float(near.float().mean()) > 0.3
        # Corners on an outline may miss their pixel's centre.
        before = (z[view] - depth)[depth > 0] < -0.03
        assert float(before.float().mean()) < 0.1, "vertices lie in front of what is seen"


# Their skeletons are named as in acclaim, cgspeed, humanik (a child), and rigify or mannequin.
CLIPS = "cmu_131_09_strut_turns ad_jumping_jacks_jumping_jacks ad_dab_dab m2m_greeting m2m_pick_up"


@pytest.mark.parametrize("motion", CLIPS.split())
def test_real_people_move_as_people_do(shared, motion):
    people, heights, lows = shared / "performers", [], []
    clip = people / f"motions/train/{motion}.bvh"
    performer = GltfPerformer(people / "train/Black_F_3_Casual.glb", clip, 1, 1.0)
    for t in (0.0, 0.35, 0.7):
        mesh = performer.pose(t).mesh
        assert bool(torch.isfinite(mesh.vertices).all())
        corners = mesh.vertices[mesh.faces]
        # At rest this character's longest edge is 0.263 m.
        assert float((corners - corners.roll(1, 1)).norm(dim=-1).max()) < 0.3, "exploded vertices"
        low, high = mesh.vertices[:, 1].aminmax()
        heights.append(float(high))
        lows.append(float(low))
    assert all(1.2 < h < 2.4 for h in heights)
    assert min(map(abs, lows)) < 0.06 and max(lows) < 0.35
    assert np.ptp(heights) < 1


def test_real_people_change_their_clothes(shared):
    people = shared / "performers"
    files = people / "train" / "Black_F_3_Casual.glb", people / "motions" / "train" / "m2m_greeting.bvh"
    plain, varied = (GltfPerformer(*files, 4, 1.0, variety) for variety in (0.0, 1.0))
    one, other = (performer.pose(0.0) for performer in (plain, varied))
    assert torch.equal(one.mesh.vertices, other.mesh.vertices)
    changed = [float((a - b).abs().mean()) for a, b in zip(one.textures, other.textures, strict=True)]
    assert max(changed) > 0.02


@pytest.mark.parametrize("make", [ring_rig, dome_rig])
@pytest.mark.parametrize("count", [1, 4, 60])
def test_rigs_hold_an_upright_person(make, count):
    cameras = make(count, (320, 240), seed=7)
    assert len(cameras) == count == len(set(cameras.names))
    assert bool(is_rotation(cameras.camera_from_world[:, :3, :3]).all())
    uv, z = project(torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.8, 0.0]]), cameras)
    assert float(z.min()) > 1
    assert float(uv.min()) > 0 and float(uv[..., 1].max()) < 240 and float(uv[..., 0].max()) < 320
    assert float((uv[:, 0, 1] - uv[:, 1, 1]).min()) > 0, "the feet are below the head"
    assert float(cameras.centers[:, 1].min()) > 0.5


def test_posing_is_the_weighted_mean_of_rigid_motions(rng):
    points, weights = torch.randn(50, 3, generator=rng), torch.rand(50, 4, generator=rng)
    normals = torch.nn.functional.normalize(torch.randn(50, 3, generator=rng), dim=-1)
    turns = rotation_from_axis_angle(torch.randn(5, 3, generator=rng))
    motions = rigid(turns, torch.randn(5, 3, generator=rng))
    faces = torch.arange(48).reshape(16, 3)
    rest = TexturedMesh(Mesh(points, faces), normals, points[:, :2], faces[:, 0], (torch.rand(3, 2, 2),))
    joints = torch.randint(0, 5, (50, 4), generator=rng)
    bound = BoundMesh(rest, joints, weights / weights.sum(1, keepdim=True))
    expected = torch.zeros_like(points)
    for v in range(len(points)):
        for slot in range(4):
            motion = motions[joints[v, slot]]
            expected[v] += bound.weights[v, slot] * (motion[:3, :3] @ points[v] + motion[:3, 3])
    torch.testing.assert_close(bound.skin(motions).mesh.vertices, expected)
    moved_by_one = replace(bound, joints=torch.full_like(joints, 2)).skin(motions)
    torch.testing.assert_close(moved_by_one.normals, normals @ motions[2, :3, :3].T)


def test_threads_that_draw_different_times_get_their_own(monkeypatch):
    """As a program that reads ahead while it draws the truth of the last time."""

    def light(scene, lights, pyramid) -> Surface:
        surface = Surface.__new__(Surface)
        object.__setattr__(surface, "drawn", torch.full((10000,), scene.time))
        return surface

    studio = Studio(StudioConfig(cameras=2, frames=2, size_px=32))
    monkeypatch.setattr(studio, "scene", lambda time: SimpleNamespace(time=time, textures=()))
    monkeypatch.setattr(stage, "texture_pyramid", lambda textures: None)
    monkeypatch.setattr(stage, "light", light)
    with ThreadPoolExecutor(2) as pool:
        drawn = pool.map(lambda time: {int(studio._surface(time).drawn[0]) for _ in range(5000)}, range(2))
        assert list(drawn) == [{0}, {1}]
