"""The pre-training stages of `paper-small`: windows, the autoencoder, masked images, and attention supervision."""

from dataclasses import replace

import attention_loss
import paper_windows
import pretrain_paper
import pytest
import torch
from models.plates import context
from training.conftest import MODEL, RUN, SAMPLING, SCENES, studio_samples

from viewmend.models.checkpoint import load_network
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.paper.tokenizer import build_context_input, reference_depth
from viewmend.training.config import TrainConfig
from viewmend.training.loop import train
from viewmend.training.shards import read_shard, sample_to_bytes, shards_of, write_shards
from viewmend.types import WindowPart

SIDE_PX = 108


def middle(sample):
    holes = torch.nonzero(sample.view.error > 0)
    row, column = holes[len(holes) // 2].tolist()
    return row, column


@pytest.fixture(scope="module")
def whole():
    """A view of 288 x 288 pixels by perfect cameras, with some history."""
    scenes = replace(SCENES, sizes_px=(288,), num_holdout_views=1, imperfect_fraction=0.0)
    sampling = {"num_source_views": (3,), "source_view_weights": (1,), "min_history": 1, "num_ray_views": 0}
    sample = studio_samples("windows", scenes, **sampling).scene(0)[0]
    rounded = tuple(replace(views, depth=views.depth.half().float()) for views in sample.context)
    return replace(sample, view=replace(sample.view, depth=sample.view.depth.half().float()), context=rounded)


@pytest.fixture(scope="module")
def cut(whole):
    return paper_windows.window(whole, middle(whole), SIDE_PX)


def config(stage, shards, **changes) -> TrainConfig:
    options = pretrain_paper.PretrainConfig(stage=stage, model=MODEL, sampling=SAMPLING)
    return TrainConfig(name=stage, objective=options, scenes=SCENES, shards=shards, **(RUN | changes))


def objective(stage):
    torch.manual_seed(0)
    own = config(stage, None)
    return own.objective.objective(own, own.objective, None)


def offset_px(part, own):
    """Row and column at which a window begins in the whole image of its camera."""
    left, top = (own.K - part.K)[0, :2, 2].round().int().tolist()
    return top, left


def placed(inner, at, size):
    """A window's inner pixels in the whole image."""
    found = torch.zeros(size, dtype=torch.bool)
    height, width = (min(n, s - a) for n, s, a in zip(inner.shape, size, at, strict=True))
    found[at[0] : at[0] + height, at[1] : at[1] + width] = inner[:height, :width]
    return found


def restricted(whole, cut):
    """The whole images, of which only the patches of the window count."""
    contexts = []
    for views, part in zip(whole.context, cut.context, strict=True):
        views = views.select(part.frame.cameras.names)
        size, inner = views.depth.shape[1:], []
        for n, own in enumerate(part.frame.cameras.size_px.tolist()):
            at = offset_px(part.frame.cameras[n], views.frame.cameras[n])
            inner.append(placed(part.part.inner[n, : own[1], : own[0]], at, size))
        contexts.append(replace(views, part=WindowPart((288, 288), reference_depth(views.depth), torch.stack(inner))))
    inner = placed(cut.view.part.inner[0], offset_px(cut.view.camera, whole.view.camera), whole.view.mask.shape)
    part = WindowPart((288, 288), reference_depth(whole.view.depth[None]), inner[None])
    return replace(whole, view=replace(whole.view, part=part), context=tuple(contexts))


def test_a_window_is_completed_like_the_whole_images(whole, cut):
    torch.manual_seed(0)
    net = PatchTransformer(replace(MODEL, dim=64, blocks=2, top_k=None)).eval()
    with torch.no_grad():
        large, small = (net([s.view], [list(s.context)])[0] for s in (restricted(whole, cut), cut))
    top, left = offset_px(cut.view.camera, whole.view.camera)
    height, width = cut.view.mask.shape
    rows, columns = slice(top, top + height), slice(left, left + width)
    assert float(small.coverage.mean()) > 0.1 and small.inpainted.std() > 1e-3
    assert torch.equal(large.coverage[rows, columns], small.coverage) and large.coverage.sum() == small.coverage.sum()
    torch.testing.assert_close(large.inpainted[:, rows, columns], small.inpainted, atol=2e-5, rtol=0)
    shown, all_px = (sum(int(c.frame.cameras.size_px.prod(1).sum()) for c in s.context) for s in (cut, whole))
    assert shown < 0.8 * all_px and max(cut.view.mask.shape) <= SIDE_PX + 2 * paper_windows.MARGIN_PX


def test_masked_pixels_are_in_the_context_at_known_positions(whole):
    views = whole.context[0]
    torch.manual_seed(1)
    cameras, corners = set(), set()
    for sample, matches in filter(None, (pretrain_paper.mask_image(views) for _ in range(40))):
        known = sample.view.error == 0
        assert torch.equal(sample.view.rgb[:, known], sample.truth[:, known] / 255)
        assert not sample.view.rgb[:, ~known].any() and bool((sample.view.mask[~known] == 1).all())
        (number,) = matches.camera.unique().tolist()
        cameras.add(number)
        row, column = matches.pixels.unbind(1)
        assert len(row) == int(((sample.view.error > 0) & (sample.alpha > 127)).sum()) > 0
        source_column, source_row = matches.uv_px.floor().long().unbind(1)
        matted = views.frame.rgb[number].float() * (views.frame.mask[number].float() / 255)
        assert torch.equal(sample.truth[:, row, column], matted[:, source_row, source_column].round().to(torch.uint8))
        corners.add(tuple((matches.uv_px[0] - 0.5 - matches.pixels[0].flip(0)).tolist()))
    assert cameras == set(range(len(views.frame.cameras))) and len(corners) > 20, "grids are shifted at random"
    blank = replace(views, frame=replace(views.frame, mask=torch.zeros_like(views.frame.mask)))
    assert pretrain_paper.mask_image(blank) is None


def test_patches_are_decoded_from_their_own_token(whole):
    net = objective("autoencoder").model.eval()
    stack = build_context_input(whole.context[0], MODEL)
    with torch.no_grad():
        decoded, patches = pretrain_paper.through_tokens(net, [stack, stack])
        alone = net.decoder(net.tokeniser([stack]))
    count = len(stack.places)
    assert decoded.shape == patches.shape == (2 * count, 3, 28, 28)
    torch.testing.assert_close(decoded[:count], alone, atol=1e-5, rtol=0)
    view_, row, column = stack.places[count // 2].tolist()
    image = stack.channels[view_, :3, 16 * row : 16 * row + 28, 16 * column : 16 * column + 28]
    assert torch.equal(patches[count // 2][:, : image.shape[1], : image.shape[2]], image)


def test_attention_is_supervised_by_the_true_positions(whole):
    """The loss falls while only attention is trained."""
    own = objective("masked")
    torch.manual_seed(2)
    sample, matches = next(filter(None, (pretrain_paper.mask_image(whole.context[0]) for _ in range(9))))
    optimizer, losses = torch.optim.Adam(own.model.parameters(), 3e-3), []
    for _ in range(25):
        frames = own.model.encode_windows([sample.view], [sample.context])
        [loss] = attention_loss.attention_losses(own.model, [sample.view], frames, [matches])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] - 0.5, losses


def test_missed_attention_equals_its_definition(rng):
    Q, K = torch.randn(3, 2, 4, 6, generator=rng), torch.randn(3, 2, 5, 6, generator=rng)
    present = torch.tensor([[1, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 0, 0, 0, 0]], dtype=torch.bool)
    sought = torch.rand(3, 4, 5, generator=rng) > 0.6
    sought[1] = False
    sought[0, 2] = False
    found = attention_loss.missed_attention(Q, K, present, sought, 0.7)
    weights = ((Q[0] @ K[0].mT) * 0.7).masked_fill(~present[0], -torch.inf).softmax(-1)
    there = sought[0] & present[0]
    costs = [-torch.log(weights[:, q, there[q]].sum(1).mean()) for q in range(4) if there[q].any()]
    torch.testing.assert_close(found[0], torch.stack(costs).mean())
    assert found[1:] == [None, None], "no key is sought; no key is present"


def test_sought_keys_equal_the_loops(rng):
    torch.manual_seed(0)
    template = PatchTransformer(MODEL).eval().encode_contexts([context(5)])[0][0]

    def frame(name, time, places):
        own = slice(len(places))
        parts = {n: getattr(template, n)[own] for n in ("uv_px", "points_world", "valid", "tokens")}
        parts |= {"keys_values": template.keys_values[:, :, own], "places": torch.tensor(places)}
        return replace(template, camera=replace(template.camera, names=(name,)), time=time, **parts)

    grid = [(row, column) for row in range(2) for column in range(3)]
    frames = [frame("a", 7, grid), frame("b", 7, grid[::2]), frame("a", 3, grid[::-1]), frame("unknown", 7, grid)]
    count = 60
    matches = attention_loss.Correspondences(
        ("b", "a"),
        torch.randint(0, 100, (count, 2), generator=rng),
        torch.randint(0, 2, (count,), generator=rng),
        torch.tensor([7, 3])[torch.randint(0, 2, (count,), generator=rng)],
        70 * torch.rand(count, 2, generator=rng),
    )
    queries = torch.tensor([(0, row, column) for row in range(6) for column in range(6) if (row + column) % 3])
    expected = torch.zeros(len(queries), sum(len(f.places) for f in frames), dtype=torch.bool)
    for n in range(count):
        row, column = (matches.pixels[n] + 0.5).tolist()
        u, v = matches.uv_px[n].tolist()
        for q, (_, qr, qc) in enumerate(queries.tolist()):
            if not (-8 <= row - (16 * qr + 14) < 8 and -8 <= column - (16 * qc + 14) < 8):
                continue
            key = 0
            for f in frames:
                for pr, pc in f.places.tolist():
                    same = f.name == matches.names[int(matches.camera[n])] and f.time == int(matches.time[n])
                    expected[q, key] |= same and abs(u - (16 * pc + 14)) < 14 and abs(v - (16 * pr + 14)) < 14
                    key += 1
    assert torch.equal(attention_loss.find_sought_keys(matches, queries, frames), expected)
    assert 5 < int(expected.sum()) < expected.numel() / 4


def test_both_stages_train_from_windows(whole, tmp_path):
    class One:
        def scene(self, number):
            return [whole]

    windows = paper_windows.WindowScenes(One(), "s", 4)
    first, again = windows.scene(0), windows.scene(0)
    assert [sample_to_bytes(s) for s in first] == [sample_to_bytes(s) for s in again] and len(first) == 4
    list(write_shards(first, tmp_path / "windows"))
    torch.manual_seed(0)
    before = PatchTransformer(MODEL).state_dict()
    autoencoder = train(config("autoencoder", tmp_path / "windows"), tmp_path / "autoencoder")
    after = load_network(autoencoder)
    changed = {n.split(".")[0] for n, w in after.state_dict().items() if not torch.equal(w, before[n])}
    assert changed == {"tokeniser", "decoder"}
    assert "L1 of patches of camera images" in (autoencoder / "README.md").read_text()
    run = config("masked", tmp_path / "windows", steps=40, learning_rate=3e-3, warmup=5, batch=4, replay_size=4)
    losses = []
    train(run, tmp_path / "masked", after, lambda progress: losses.append(progress.losses["total"]))
    assert sum(losses[-8:]) < 0.9 * sum(losses[:8])
    assert "0.1 x attention" in (tmp_path / "masked/README.md").read_text()


@pytest.mark.slow
def test_the_commands_run(tmp_path):
    scenes = ["--scenes.sizes-px", "128", "--scenes.cameras", "5", "5", "--scenes.num-holdout-views", "1"]
    windows = tmp_path / "windows"
    pretrain_paper.main(["windows", "--out", str(windows), "--count", "8", "--workers", "0", *scenes])
    assert sum(len(read_shard(path)) for path in shards_of(windows)) == 8
    brief = ["--shards", str(windows), "--steps", "1", "--batch", "1", "--workers", "0"]
    pretrain_paper.main(["autoencoder", "--out", str(tmp_path / "autoencoder"), *brief])
    start = ["--from", str(tmp_path / "autoencoder")]
    pretrain_paper.main(["masked", "--out", str(tmp_path / "masked"), *brief, *start])
    assert (tmp_path / "masked/model.safetensors").exists()
