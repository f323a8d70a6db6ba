"""A copy of a camera image: what is blotted out stands in its context, truly and at known places."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from training.conftest import MODEL as CHAIN
from training.conftest import PLAN
from training.test_autoencoder import MODEL, recipe_of, taught_by

from viewmend.geometry.cameras import project, unproject
from viewmend.inpainting.chain import build
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.images import context_images
from viewmend.training.copies import BLOT_RADIUS_PX, BLOTS, MISPLACED_PX, CopyingObjective, copy_of
from viewmend.training.loop import train
from viewmend.training.objective import Objective
from viewmend.training.plan import LossWeights, WholeViewRecipe
from viewmend.training.recipes import RECIPES
from viewmend.training.sample_files import read_shard
from viewmend.training.through_tokens import DECODED, encode_and_decode, patch_loss, through_tokens
from viewmend.training.windows import window

LOSS = LossWeights(channels="sum", attention=0.1, autoencoder=0.5)

recipe = partial(recipe_of, "copies", loss=LOSS)


@pytest.fixture
def sample(shards):
    return read_shard(sorted(shards.glob("*.tar"))[0])[0]


def copies(views, count=40):
    torch.manual_seed(1)
    return [copy for _ in range(count) if (copy := copy_of(views)) is not None]


def test_what_is_missing_is_in_the_context_at_the_very_pixel(sample):
    views = sample.context[0]
    taken = set()
    for copy in copies(views):
        matches = copy.matches
        assert matches is not None and matches.names == views.frame.cameras.names
        (number,) = matches.camera.unique().tolist()
        taken.add(number)
        assert matches.time.unique().tolist() == [copy.view.time] == [views.frame.time]
        row, column = matches.pixels.unbind(1)
        assert bool((copy.view.error[row, column] == 1).all())
        source_column, source_row = matches.uv_px.floor().long().unbind(1)
        matted = views.frame.rgb[number].float() * (views.frame.mask[number].float() / 255)
        shown = matted[:, source_row, source_column].round().to(torch.uint8)
        assert torch.equal(copy.truth[:, row, column], shown)
        of_subject = (copy.view.error > 0) & (copy.alpha > 127)
        assert len(row) == int(of_subject.sum()) > 0
    assert taken == set(range(len(views.frame.cameras)))


def test_what_is_not_missing_is_right_and_what_is_counts_as_subject(sample):
    for copy in copies(sample.context[0]):
        view, truth = copy.view, copy.truth.float() / 255
        known = view.error == 0
        assert torch.equal(view.rgb[:, known], truth[:, known])
        assert not view.rgb[:, ~known].any() and bool((view.mask[~known] == 1).all())
        assert torch.equal(view.mask[known], copy.alpha.float()[known] / 255)
        assert torch.equal(view.weights.sum(0) > 0, known & (view.mask > 0))
        assert int((~known).sum()) <= BLOTS * 3.15 * BLOT_RADIUS_PX[1] ** 2


def test_grids_differ_and_the_calibration_is_a_little_wrong(sample):
    views = sample.context[0]
    corners, offsets = set(), []
    for copy in copies(views, 120):
        number = int(copy.matches.camera[0])
        corner = copy.matches.uv_px[0] - 0.5 - copy.matches.pixels[0].flip(0)
        corners.add(tuple(corner.tolist()))
        pixel = torch.tensor([[[40.0, 40.0]]])
        point = unproject(pixel, torch.full((1, 1), 2.0), views.frame.cameras[number])
        offsets.append(project(point[0], copy.view.camera)[0][0, 0] + corner - pixel[0, 0])
    offsets = torch.stack(offsets)
    assert len(corners) > 60 and all(0 <= side < 16 for corner in corners for side in corner)
    assert 0.9 * MISPLACED_PX < float(offsets.abs().max()) <= MISPLACED_PX + 1e-3
    assert float(offsets.mean(0).abs().max()) < 1 and bool((offsets.std(0) > 1.5).all())


def test_a_window_gives_copies_within_itself(sample):
    row, column = torch.nonzero(sample.view.error > 0)[0].tolist()
    cut = window(sample, (row, column), 60, 16).context[0]
    for copy in copies(cut, 20):
        number = int(copy.matches.camera[0])
        assert copy.view.part is not None and copy.view.part.whole_size_px == cut.part.whole_size_px
        assert torch.equal(copy.view.part.reference_m, cut.part.reference_m[number : number + 1])
        left, top = (copy.matches.uv_px[0] - 0.5 - copy.matches.pixels[0].flip(0)).int().tolist()
        height, width = copy.view.mask.shape
        inner = cut.part.inner[number, top : top + height, left : left + width]
        assert torch.equal(copy.view.part.inner[0], inner)


def test_an_image_without_a_subject_is_no_copy(sample, shards):
    views = sample.context[0]
    blank = replace(views, frame=replace(views.frame, mask=torch.zeros_like(views.frame.mask)))
    assert copy_of(blank) is None
    covered = replace(views, frame=replace(views.frame, mask=None))
    assert copy_of(covered) is not None  # what the proxy covers, then
    with pytest.raises(ValueError, match="none that shows any"):
        CopyingObjective(build(MODEL), recipe(shards))([replace(sample, context=(blank,))])


def test_the_loss_is_that_of_the_copies_and_of_the_tokens_alone(sample, shards):
    net = build(MODEL).eval()
    own = recipe(shards)
    torch.manual_seed(3)
    with torch.no_grad():
        out = CopyingObjective(net, own)([replace(sample, context=sample.context[:1])])
    torch.manual_seed(3)
    torch.randint(1, ())
    copy = copy_of(sample.context[0])
    with torch.no_grad():
        again = Objective(net, replace(own, loss=replace(LOSS, autoencoder=0.0)))([copy])
        _, away = encode_and_decode(net, [[net.looked_at(copy.view, copy.context)[0]]], "sum")
    assert float(out.total) == pytest.approx(float(again.total) + 0.5 * float(away), rel=1e-4)
    assert float(away) > 0


def test_context_is_encoded_once_for_both_and_is_what_it_was(sample):
    net = build(MODEL).eval()
    contexts = [list(sample.context), list(sample.context[:1])]
    with torch.no_grad():
        frames, away = encode_and_decode(net, contexts, "mean")
        made, shown = through_tokens(net, [context_images(v, MODEL) for context in contexts for v in context])
        for context, encoded in zip(contexts, frames, strict=True):
            alone = [frame for views in context for frame in net.encode_contexts([views])[0]]
            assert [(f.name, f.time) for f in encoded] == [(f.name, f.time) for f in alone]
            for one, other in zip(encoded, alone, strict=True):
                torch.testing.assert_close(one.tokens, other.tokens, atol=1e-5, rtol=0)
    assert sum(map(len, contexts)) <= DECODED
    assert float(away) == pytest.approx(float(patch_loss(made, shown, "mean")), rel=1e-4)
    kept, _ = encode_and_decode(net, [frames[1]], "mean")
    assert kept[0][0] is frames[1][0]


def test_a_run_teaches_all_of_the_patches_and_windows_go_on_from_it(shards, tmp_path):
    _, moved = taught_by(recipe(shards, seed=0), tmp_path / "run")
    assert moved == {"tokeniser", "transformer", "decoder"}
    card = (tmp_path / "run" / "README.md").read_text()
    assert "0.1 x attention, 0.5 x autoencoder" in card and "part `copies`" in card
    chain = train(recipe(shards, model=CHAIN), tmp_path / "chain")
    assert load_network(str(chain)) is not None


def test_learning_reduces_what_copies_miss(shards, tmp_path):
    """Forty steps on a few samples: the loss of copies falls."""
    run = recipe(shards, steps=40, learning_rate=3e-3, warmup=5, batch=4, replay_size=4, checkpoint_every=100)
    losses = []
    train(run, tmp_path / "run", report=lambda progress: losses.append(progress.losses.total))
    assert sum(losses[-8:]) < 0.8 * sum(losses[:8])


def test_what_it_cannot_be_judged_by_is_refused():
    own = RECIPES["copies"](PLAN)
    assert not isinstance(own, WholeViewRecipe)
    assert own.loss.attention and own.loss.autoencoder and own.part == "copies"
    with pytest.raises(ValueError, match="adversarial"):
        replace(own, loss=LossWeights(adversarial=0.1))
