"""Training of `views`: stored scenes, crops, the loss, captures, and the error predictor."""

import zlib
from contextlib import nullcontext
from dataclasses import replace
from random import Random

import pytest
import torch
from reference.other_device import DEVICE, other_device
from reference.shared_scenes import make_once
from training.conftest import RUN, SCENES, VIEWS_MODEL, VIEWS_RENDER, VIEWS_SAMPLING, VIEWS_SCENES, log_of

from viewmend.geometry.cameras import project, unproject
from viewmend.geometry.rasterize import rasterize
from viewmend.geometry.rim import rim_depth
from viewmend.models.base import DepthMap
from viewmend.models.checkpoint import load_network, save_inpainter
from viewmend.models.classical import Unfilled
from viewmend.models.smooth_fill import fill
from viewmend.models.views.grid import nearest_depth
from viewmend.models.views.model import ViewSynthNet
from viewmend.scenes.held_out import LeaveOneOut
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.config import TrainConfig
from viewmend.training.depth_geometry import DepthErrors
from viewmend.training.loop import train
from viewmend.training.scenes import Scene, StudioRigs, rig_source
from viewmend.training.shards import (
    ShardError,
    ShardScenes,
    read_shard,
    sample_from_bytes,
    sample_to_bytes,
    shards_of,
    write_shards,
)
from viewmend.training.stored_scenes import StoredSamples, StoredScene, StoredSceneMaker, store_scene
from viewmend.training.views import (
    CROP_PX,
    TrainingView,
    TrainingViews,
    ViewsLossWeights,
    ViewsObjectiveConfig,
    initial_model,
    random_crop,
    random_selection,
    recolour,
    visible_cameras,
)
from viewmend.utils.tensors import to_device

OPTIONS = ViewsObjectiveConfig(model=VIEWS_MODEL, sampling=VIEWS_SAMPLING)


@pytest.fixture(scope="module")
def studio():
    return Studio(StudioConfig(seed=3, cameras=6, frames=1, size_px=(160, 149)))


def scene_of(studio):
    def truth(held, time):
        return studio.truth(studio.true_cameras.select([held]), time)

    return Scene(LeaveOneOut({0: studio.read(0)}, true_view=truth), Random(0))


@pytest.fixture(scope="module")
def stored(studio):
    return store_scene(scene_of(studio), replace(VIEWS_SCENES, num_holdout_views=6))


@pytest.fixture(scope="module")
def view(stored):
    return TrainingView.of(stored.sample(0, VIEWS_RENDER, 4), ViewSynthNet(VIEWS_MODEL))


@pytest.fixture(scope="session")
def capture(takes):
    return takes / "ada"


@pytest.fixture(scope="session")
def view_shards(tmp_path_factory):
    def write(folder):
        maker = StoredSceneMaker(StudioRigs(VIEWS_SCENES, (0,), "tests"), VIEWS_SCENES)
        list(write_shards((maker.scene(number)[0] for number in range(3)), folder, shard_size=2))

    return make_once(tmp_path_factory, "view-shards", write)


@pytest.fixture
def tiny_views(view_shards) -> TrainConfig:
    return TrainConfig(name="views", objective=OPTIONS, scenes=VIEWS_SCENES, shards=view_shards, **RUN)


def test_a_stored_scene_is_the_rig_without_a_camera(studio, stored):
    frame = studio.read(0)
    assert sorted(view.name for view in stored.held) == sorted(frame.cameras.names)
    assert len(zlib.compress(sample_to_bytes(stored), 1)) < 0.3 * frame.rgb.numel() * len(stored.held)
    again = sample_from_bytes(sample_to_bytes(stored))
    for number in (0, 3):
        name = stored.held[number].name
        stream = Stream(ViewSynthNet(VIEWS_MODEL), StreamConfig(render=VIEWS_RENDER, memory_mb=None))
        stream.add_frame(frame.without([name]), None)
        expected = stream.render(frame.cameras.select([name]))
        sample = again.sample(number, VIEWS_RENDER, 4)
        view = sample.view
        assert name not in view.candidate_views and view.source_views == expected.source_views
        # The stored hull is coarser, and its vertices are quantised.
        both = (view.mask > 0) & (expected.mask > 0)
        assert float(both.sum() / ((view.mask > 0) | (expected.mask > 0)).sum()) > 0.93
        assert float((view.rgb - expected.rgb).abs()[:, both].median()) < 0.02
        true = studio.truth(studio.true_cameras.select([name]), 0)
        assert torch.equal(sample.alpha, true.mask[0])
        assert float((sample.depth - true.depth[0]).abs().max()) < 1e-4
        black = (true.rgb[0] * (true.mask[0] / 255)).round()
        assert float((sample.truth - black).abs().max()) <= 1
        near = sample.ray_views.frame
        assert near.cameras.names == view.closest_views(4)
        own = frame.select(near.cameras.names)
        inside = own.mask > 0
        assert torch.equal(near.mask, own.mask)
        assert torch.equal(near.rgb.movedim(1, -1)[inside], own.rgb.movedim(1, -1)[inside])
        both = (near.depth > 0) & (own.depth > 0)
        assert float((near.depth - own.depth)[both].abs().median()) < 0.01, "of every second pixel"


class TrueDepth(Unfilled):
    """Predicts the depth of the true surface, with full confidence."""

    predicts_depth = True

    def __init__(self, studio):
        self.mesh = studio.scene(0).mesh

    def predict_depth(self, view, context):
        depth = rasterize(self.mesh, view.camera).depth[0] * (view.depth > 0)
        return DepthMap(depth, (depth > 0).float())


def test_cameras_that_are_held_out_together_share_fused_geometry(studio):
    config = replace(VIEWS_SCENES, num_holdout_views=6, fused_fraction=1.0)
    rig = scene_of(studio).rig
    scene = sample_from_bytes(sample_to_bytes(store_scene(Scene(rig, Random(0)), config, TrueDepth(studio))))
    assert len(scene.held) == 1, "a quarter of six cameras"
    held = scene.held[0]
    assert held.left_out == (held.name,)
    hull = store_scene(Scene(rig, Random(0)), config)
    assert len(hull.held) == 6 and held.name == hull.held[0].name and not hull.held[0].left_out

    def error_m(stored):
        sample = stored.sample(0, VIEWS_RENDER, 4)
        both = (sample.view.depth > 0) & (sample.depth > 0)
        return float((sample.view.depth - sample.depth)[both].abs().mean())

    assert error_m(scene) < 0.7 * error_m(hull)


def test_cameras_that_are_held_out_together_do_not_colour_each_other(stored):
    names = tuple(view.name for view in stored.held[:2])
    together = replace(stored, held=(replace(stored.held[0], left_out=names), *stored.held[1:]))
    assert not set(together.sample(0, VIEWS_RENDER, 4).view.candidate_views) & set(names)
    assert names[1] in stored.sample(0, VIEWS_RENDER, 4).view.candidate_views


def test_views_behind_depth_maps_have_the_true_surface_and_its_errors(stored, view):
    exact = stored.sample(0, VIEWS_RENDER, 4, DepthErrors())
    assert torch.equal(exact.view.depth, exact.depth)
    shown = (exact.view.mask > 0) & ~exact.view.holes & (exact.alpha == 255)
    off = (exact.view.rgb - exact.truth / 255).abs().amax(0)[shown]
    hull = stored.sample(0, VIEWS_RENDER, 4)
    behind_hull = (hull.view.rgb - hull.truth / 255).abs().amax(0)[shown & ~hull.view.holes]
    assert float((off > 0.1).float().mean()) < 0.8 * float((behind_hull > 0.1).float().mean())
    assert exact.ray_views.frame.cameras.names == exact.view.closest_views(4)
    wrong = stored.sample(0, VIEWS_RENDER, 4, DepthErrors(bias_m=0.02, step_m=0.01, grow_px=2, holes=0.05))
    both = (wrong.view.depth > 0) & (exact.view.depth > 0)
    assert float((wrong.view.depth - exact.view.depth)[both].median()) == pytest.approx(0.02, abs=0.006)
    assert int((wrong.view.depth > 0).sum()) > int((exact.view.depth > 0).sum()), "it grew"
    assert int(((wrong.view.depth == 0) & (exact.view.depth > 0)).sum()) > 20, "it has holes"


def test_errors_of_depth_maps_follow_from_the_number_of_the_scene(stored):
    """Whatever else draws random numbers: other processes make the same samples."""

    class Same:
        def scene(self, number):
            return [stored]

    source = StoredSamples(Same(), replace(VIEWS_SAMPLING, depth_fraction=1.0), "0")
    made = []
    for number in (0, 0, 1):
        torch.rand(1)
        made.append([sample.view.depth for sample in source.scene(number)])
    first, again, other = made
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert any(not torch.equal(a, b) for a, b in zip(first, other, strict=True))
    errors = DepthErrors(noise_m=0.01)
    generator = errors.generator()
    one, two = (errors.apply(torch.ones(9, 9), generator) for _ in range(2))
    assert not torch.equal(one, two), "each map has noise of its own"


def test_drawn_errors_are_of_all_kinds_and_some_have_none():
    drawn = [DepthErrors.draw(Random(n)) for n in range(200)]
    assert 40 < drawn.count(DepthErrors()) < 100
    for name in ("bias_m", "noise_m", "waves_m", "step_m", "smooth_px", "grow_px", "holes"):
        assert sum(getattr(errors, name) != 0 for errors in drawn) > 20, name
    depth = torch.zeros(40, 30)
    depth[5:35, 5:25] = 2.0
    for errors in drawn:
        found = errors.apply(depth, errors.generator())
        assert found.shape == depth.shape and bool(torch.isfinite(found).all()) and float(found.min()) >= 0
        assert float((found[found > 0] - 2).abs().median()) < 0.1


def test_a_crop_is_a_part_of_the_view_and_of_its_truth(view):
    torch.manual_seed(1)
    num_cameras = set()
    for _ in range(30):
        crop = random_crop(view)
        height, width = crop.view.mask.shape
        assert height <= CROP_PX and width <= CROP_PX and int((crop.view.mask > 0).sum()) > 0
        assert crop.truth.shape[1:] == crop.alpha.shape == crop.depth.shape == (height, width)
        assert crop.scale == view.scale
        names = crop.sources.views.frame.cameras.names
        assert names == view.sources.views.frame.cameras.names[: len(names)]
        assert len(crop.sources.pyramids) == len(names)
        num_cameras.add(len(names))
        # The camera of the crop sees the same points at the same pixels.
        at = torch.tensor([[[width / 2, height / 2]]])
        point = unproject(at, torch.tensor([[2.0]]), crop.view.camera)[0]
        uv, _ = project(point, view.view.camera)
        left, top = (uv[0, 0] - at[0, 0]).round().int().tolist()
        assert torch.equal(view.truth[:, top : top + height, left : left + width], crop.truth)
        assert torch.equal(view.view.rgb[:, top : top + height, left : left + width], crop.view.rgb)
    assert num_cameras == {3, 4}, "all four, or three of them"


def test_a_selection_of_pixels_is_on_the_subject_and_contains_the_holes(view):
    torch.manual_seed(0)
    selections = [found for _ in range(40) if (found := random_selection(view)) is not None]
    assert 4 < len(selections) < 24
    assert all(bool((rim_depth(view.view.depth)[found] > 0).all()) for found in selections)
    assert all(bool(found[view.view.holes].all()) for found in selections)


def test_colours_change_alike_in_cameras_view_and_truth(stored):
    sample = stored.sample(0, VIEWS_RENDER, 4)
    other = recolour(sample, Random(2))
    gains = []
    for before, after in (
        (sample.view.rgb, other.view.rgb),
        (sample.truth / 255, other.truth / 255),
        (sample.ray_views.frame.rgb[0] / 255, other.ray_views.frame.rgb[0] / 255),
    ):
        means, changed = before.mean((1, 2)).sort().values, after.mean((1, 2)).sort().values
        gains.append(changed / means)
    assert 0.55 < float(gains[0].mean()) < 1
    for gain in gains[1:]:
        torch.testing.assert_close(gain, gains[0], atol=0.02, rtol=0)


def test_visible_cameras_see_the_true_surface(view):
    torch.manual_seed(0)
    net = ViewSynthNet(VIEWS_MODEL)
    with torch.no_grad():
        made = net(view.view, view.sources, view.scale)
    cells = tuple(made.distribution.cells.T)
    z = nearest_depth(view.depth)[cells]
    seen = visible_cameras(view, made, z)
    assert seen.shape == (len(z), 4) and 0.2 < float(seen[z > 0].float().mean()) < 0.95
    assert not bool(seen[z == 0].any())
    # The camera closest in angle sees most of it, and nearly none of a surface moved away.
    assert float(seen[:, 0].float().mean()) >= float(seen[:, 3].float().mean()) - 0.05
    behind = visible_cameras(view, made, z + 0.3 * view.scale.size_m)
    assert int(behind.sum()) < 0.3 * int(seen.sum())


def test_holes_are_filled_by_the_ray_fill_of_another_model(stored, tmp_path):
    """It fills the whole view, not its crops, and is not trained."""
    options = replace(OPTIONS, model=replace(VIEWS_MODEL, num_views=8, coarse_fill="rays"))
    net, rays = initial_model(options, "float32"), load_network("rays")
    assert torch.equal(net.coarse.choose.weight, rays.choose.weight)
    assert not any(weight.requires_grad for weight in net.coarse.parameters())
    assert all(
        weight.requires_grad for name, weight in net.named_parameters() if not name.startswith("coarse.")
    )
    sample = stored.sample(0, VIEWS_RENDER, 4)
    view = TrainingView.of(sample, net)
    holes = view.view.holes
    assert int(holes.sum()) > 30 and torch.equal(view.filled[:, ~holes], view.view.rgb[:, ~holes])
    expected = rays(replace(view.view, error=holes.float()), view.sources)
    torch.testing.assert_close(view.filled, expected, atol=1e-5, rtol=0)
    torch.manual_seed(3)
    crop = random_crop(view)
    height, width = crop.filled.shape[1:]
    parts = view.filled.unfold(1, height, 1).unfold(2, width, 1)
    assert bool((parts == crop.filled[:, None, None]).all(-1).all(-1).all(0).any())
    save_inpainter(ViewSynthNet(VIEWS_MODEL), tmp_path, "")
    with pytest.raises(ValueError, match="expected a model with a ray fill"):
        initial_model(replace(options, coarse_from=str(tmp_path)), "float32")


@pytest.mark.parametrize(
    ("has_units", "precision", "expected"),
    [
        (False, "bfloat16", torch.float32),
        (True, "bfloat16", torch.bfloat16),
        (True, "float32", torch.float32),
    ],
)
def test_workers_fill_holes_in_a_precision_that_suits_the_cpu(
    view_shards, monkeypatch, has_units, precision, expected
):
    """A run on a GPU is in bfloat16, but its samples are made on the CPU."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": has_units})
    run = RUN | {"precision": precision}
    config = TrainConfig(name="views", objective=OPTIONS, shards=view_shards, **run)
    objective = OPTIONS.make_objective(config, OPTIONS, None)
    assert objective.training_scenes("0").net.compute_dtype == expected
    assert objective.model.compute_dtype == (torch.bfloat16 if precision == "bfloat16" else torch.float32)


@pytest.mark.parametrize(
    "term", ["colour", "log_error", "gradient", "cell_colour", "alpha", "depth", "visibility", "errors"]
)
def test_each_term_alone_can_be_minimised(view, term):
    weights = ViewsLossWeights(**dict.fromkeys(vars(ViewsLossWeights()), 0.0) | {term: 1.0})
    objective = make_objective(replace(OPTIONS, loss=weights))
    optimizer = torch.optim.Adam(objective.parameters(), 3e-3)
    losses = []
    for _ in range(24):
        torch.manual_seed(5)
        optimizer.zero_grad()
        loss = objective([view]).total
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
        if losses[-1] < losses[0] - 0.02 * abs(losses[0]):
            return
    pytest.fail(f"the term did not fall by 2 %: {losses}")


@pytest.mark.parametrize("ray_views", [2, 4])
def test_steps_are_made_on_any_device(view, ray_views, monkeypatch):
    """Also with more cameras than are sampled on a ray."""
    monkeypatch.setattr("viewmend.models.views.model.RAY_VIEWS", ray_views)
    monkeypatch.setattr("viewmend.training.views.SPARSE", 1.0)  # of selected pixels
    losses = []
    for device in ("cpu", DEVICE):
        with other_device(monkeypatch) if device == DEVICE else nullcontext():
            objective = make_objective(OPTIONS).to(device)
            torch.manual_seed(0)
            total = objective([to_device(view, device)]).total
            total.backward()
            assert total.device == objective.model.depth_logits.weight.grad.device == torch.device(device)
            losses.append(float(total.detach()))
    assert losses[1] == pytest.approx(losses[0], rel=1e-2)


@pytest.mark.gpu
@pytest.mark.parametrize("precision", ["float32", "auto"])
def test_cuda_makes_the_steps_of_both_recipes(tiny_views, capture, tmp_path, precision):
    """With validation."""
    config = replace(tiny_views, steps=2, validate_every=1, validation_views=1, precision=precision)
    scenes = replace(VIEWS_SCENES, captures=(capture,), captures_fraction=1.0, hold_out="auto")
    for name, own in (("views", config), ("finetune", replace(config, scenes=scenes, shards=None))):
        out = train(own, tmp_path / name)
        assert [entry["step"] for entry in log_of(out) if "losses" in entry] == [1, 2]


def make_objective(options, start=None):
    torch.manual_seed(0)
    return options.make_objective(TrainConfig(name="views", objective=options, **RUN), options, start)


def test_every_parameter_gets_a_gradient(view):
    objective = make_objective(OPTIONS)
    output = objective([view, view])
    output.total.backward()
    still = [
        n for n, p in objective.model.named_parameters() if p.grad is None or float(p.grad.abs().sum()) == 0
    ]
    assert still == []
    assert float(output.image.outside) > 0 and float(output.image.log_error) < 0


def test_the_error_predictor_can_be_trained_alone(tiny_views, tmp_path):
    config = replace(tiny_views, objective=replace(OPTIONS, train_params="errors"), steps=3, batch=1)
    with pytest.raises(ValueError, match="with an error predictor for --train-params errors"):
        train(config, tmp_path / "none")
    torch.manual_seed(0)
    start = ViewSynthNet(replace(VIEWS_MODEL, error_features=0))
    trained = load_network(train(config, tmp_path / "run", start=start))
    assert all(torch.equal(trained.state_dict()[name], weight) for name, weight in start.state_dict().items())
    again = load_network(train(replace(config, steps=1), tmp_path / "more", start=trained))
    pairs = zip(again.errors.state_dict().values(), trained.errors.state_dict().values(), strict=True)
    moved = [float((a - b).abs().max()) for a, b in pairs]
    assert 0 < max(moved) < 0.1, "it starts from the trained predictor"


def test_a_run_resumes_and_is_validated(tiny_views, tmp_path):
    config = replace(tiny_views, validate_every=4, validation_views=1)
    once = train(config, tmp_path / "once")
    train(replace(config, steps=2), tmp_path / "twice")
    twice = train(config, tmp_path / "twice")
    logs = [log_of(run) for run in (once, twice)]
    scores = next(line["validation"] for line in logs[0] if line.get("validation"))
    assert scores["rendered"] > 10 and scores["completed"] > 5 and (once / "validation-000004.png").exists()
    losses = [[line["losses"]["total"] for line in run if "losses" in line] for run in logs]
    assert len(losses[0]) == len(losses[1]) == 4 and losses[0][:2] == losses[1][:2]


@pytest.mark.slow
def test_captures_are_trained_on(capture, tmp_path):
    """Their held-out cameras are targets, without true depth; the card names them."""
    scenes = replace(VIEWS_SCENES, captures=(capture,), captures_fraction=1.0)
    config = TrainConfig(name="views", objective=OPTIONS, scenes=scenes, **RUN)
    found = make_objective(OPTIONS)
    found.config = config
    [first, *_] = found.training_scenes("0").scene(0)
    assert first.depth is None and first.sources.views.frame.depth is None
    names = first.sources.silhouettes.cameras.names + first.view.camera.names
    assert sorted(names) == [f"cam{n:02d}" for n in range(5)]
    loss = found([first])
    loss.total.backward()
    assert torch.isfinite(loss.total)
    out = train(config, tmp_path / "run")
    assert "100% of the scenes from captures (ada)" in (out / "README.md").read_text()
    stored = OPTIONS.make_scenes(scenes, "0").scene(0)[0]
    again = sample_from_bytes(sample_to_bytes(stored))
    assert again.depth is None and again.sample(0, VIEWS_RENDER, 4).depth is None


def test_captures_and_studio_are_mixed(capture):
    source = rig_source(replace(SCENES, captures=(capture,), captures_fraction=0.5), (0,), "0")
    names = {type(source.rig(number).rig.true_view).__name__ for number in range(6)}
    assert names == {"NoneType", "function"}, "captures have no rendered truth"


def test_stored_scenes_are_numbered_through_all_shards(view_shards):
    shards = ShardScenes(view_shards, "0", StoredScene, whole=False)
    scenes = [shards.scene(number) for number in range(4)]
    assert sorted(map(len, scenes)) == [0, 1, 1, 1], "the last shard is shorter"
    made = {sample_to_bytes(scene[0]) for scene in scenes if scene}
    assert len(made) == 3
    assert {sample_to_bytes(s) for n in range(4, 8) for s in shards.scene(n)} == made


def test_all_stored_scenes_are_used_if_the_first_shard_is_shorter(view_shards, tmp_path):
    """As `make-dataset` leaves it when it is run again with a larger count."""
    first, *others = [scene for path in shards_of(view_shards) for scene in read_shard(path)]
    list(write_shards([first], tmp_path, shard_size=2))
    list(write_shards(others, tmp_path, shard_size=2, first=1))
    shards = ShardScenes(tmp_path, "0", StoredScene, whole=False)
    made = {sample_to_bytes(scene) for number in range(4) for scene in shards.scene(number)}
    assert made == {sample_to_bytes(scene) for scene in (first, *others)}
    shards_of(tmp_path)[1].write_bytes(b"damaged")
    with pytest.raises(ShardError, match=r"shard-00001\.tar: expected a tar of samples"):
        ShardScenes(tmp_path, "0", StoredScene, whole=False)


def training_views(view_shards, seed, net, **options):
    scenes = ShardScenes(view_shards, "0", StoredScene, whole=False)
    return TrainingViews(StoredSamples(scenes, VIEWS_SAMPLING, seed), seed, net, **options)


def test_a_number_always_gives_the_same_views(view_shards):
    source, other = (training_views(view_shards, seed, ViewSynthNet(VIEWS_MODEL)) for seed in ("0", "1"))
    first, again, third = source.scene(1), source.scene(1), other.scene(1)
    assert len(first) == 2
    assert all(torch.equal(a.view.rgb, b.view.rgb) for a, b in zip(first, again, strict=True))
    assert all(torch.equal(a.truth, b.truth) for a, b in zip(first, again, strict=True))
    assert any(not torch.equal(a.truth, b.truth) for a, b in zip(first, third, strict=True))


def test_some_holes_are_filled_from_their_surroundings_only(view_shards):
    """As at run time with a small budget; colours do not depend on it."""
    net = ViewSynthNet(replace(VIEWS_MODEL, coarse_fill="rays"))

    def fills(smooth):
        scenes = training_views(view_shards, "0", net, smooth_fill=smooth)
        return [own for number in range(1, 4) for own in scenes.scene(number)]

    by_net, smooth, mixed = fills(0.0), fills(1.0), fills(0.5)
    assert all(torch.equal(a.truth, b.truth) for a, b in zip(by_net, smooth, strict=True))
    kinds = set()
    for a, b, own in zip(by_net, smooth, mixed, strict=True):
        holes = a.view.holes
        assert torch.equal(a.filled[:, ~holes], b.filled[:, ~holes])
        if bool(holes.any()):
            assert torch.equal(b.filled, fill(b.view.rgb, holes, b.view.mask > 0))
            assert not torch.equal(a.filled, b.filled)
            kinds.add(torch.equal(own.filled, b.filled))
    assert kinds == {True, False}


def test_crops_always_have_pixels_to_predict(view):
    rim = (rim_depth(view.view.depth) > 0) & (view.view.mask == 0)
    truth = torch.where(rim, 255, (255 * view.view.rgb).round().byte())  # only the rim is wrong
    torch.manual_seed(0)
    for _ in range(200):
        assert bool((random_crop(replace(view, truth=truth)).view.mask > 0).any())
