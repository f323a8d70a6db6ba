"""`paper()` and its recipe against a checklist made from the specification, by its sections."""

from dataclasses import fields, replace

import pytest
import torch
from inpainting.plates import Rig, context, view

from viewmend.baselines.classical import Telea
from viewmend.inpainting.chain import build
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.config import InpainterConfig, paper, paper_small, small
from viewmend.inpainting.context import window_times
from viewmend.inpainting.coordinates import patch_depths
from viewmend.inpainting.decoder import blend
from viewmend.inpainting.images import context_images, target_images
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.protocol import ContextProvider
from viewmend.inpainting.upon_white import UponWhite
from viewmend.training.ablations import ABLATIONS, TABLE_3
from viewmend.training.losses import image_loss
from viewmend.training.plan import DataPlan, LossWeights
from viewmend.training.recipes import RECIPES, as_the_paper
from viewmend.training.scenes import StudioScenes
from viewmend.training.true_images import true_image

CHECKLIST = {
    "widths": ("3: FuseFormer's widths", (64, 64, 128, 256, 384, 512, 384, 256, 128)),
    "dim": ("6: D", 512),
    "heads": ("6: heads", 8),
    "groups": ("6: n_g", 2),
    "blocks": ("6: n_b", 4),
    "ffn_ratio": ("6: FFN, as usual", 4),
    "n_c": ("2: n_c", 3),
    "n_w": ("2: n_w", 3),
    "k_w": ("2: k_w", 10),
    "context_cameras": ("2, 13: exactly three cameras", 3),
    "use_mask": ("3: the mask is shown", True),
    "use_depth": ("3: the pseudo depth is shown", True),
    "use_validity": ("3: no validity is shown", False),
    "min_foreground": ("4: what is not quite background stays", 0.0),
    "patch_depth": ("5: the centre's own depth", "centre"),
    "rope_unit": ("5: (u, v) in [0, 1]", "image"),
    "past_geometry": ("5: current geometry for the past", "current"),
    "rope": ("6: RoPE of queries and keys", True),
    "rope_values": ("6: values are not rotated", False),
    "top_k": ("6: k, which the paper leaves open", 512),
    "colour_skip": ("7: features alone, no colours", False),
    "background": ("13: white", "white"),
    "identity_init": ("13: no copier start", False),
    "token_norms": ("13: no norms of tokens", False),
    "coarse_fill": ("1: nothing fills before", "none"),
    "temporal_accumulation": ("9: nothing is accumulated", 0.0),
}
UNUSED = {"num_ray_views"}
"""Without rays."""


@pytest.mark.parametrize("switch", CHECKLIST)
def test_the_model_is_the_papers(switch):
    section, expected = CHECKLIST[switch]
    assert getattr(paper(), switch) == expected, section


def test_every_switch_stands_on_the_checklist_and_small_widths_change_nothing_else():
    assert {f.name for f in fields(InpainterConfig)} - UNUSED == set(CHECKLIST)
    assert paper().in_channels == 5, "RGB, mask and pseudo depth"
    sizes = {name: getattr(paper(), name) for name in ("widths", "dim", "heads")}
    assert replace(paper_small(), **sizes) == paper()
    assert isinstance(build(paper_small()), PatchTransformer), "nothing fills before it"


@pytest.mark.parametrize("name", ["paper", "paper_small"])
def test_the_recipe_is_the_papers(name):
    recipe = RECIPES[name](DataPlan())
    loss, data = recipe.loss, recipe.data
    assert loss == LossWeights(image=1.0, adversarial=0.01, channels="sum", outside="image", log_error=0.0)
    assert (loss.adversarial_kind, loss.discriminator) == ("gan", "image")
    assert data.context_cameras == (3,) and data.ray_views == 0
    last = max(data.times)
    ends = [t for t in data.times if sorted(data.times).index(t) >= data.least_past]
    assert ends == [last] and set(data.times) == set(window_times(last, paper())) and data.past == (6,)
    assert recipe.part == "all" and recipe.model.top_k == 512


@pytest.mark.parametrize("name", ABLATIONS)
def test_an_ablation_is_the_papers_model_less_what_it_states(name):
    recipe, changes = ABLATIONS[name](DataPlan()), len(TABLE_3.get(name, {}))
    different = [
        f.name for f in fields(InpainterConfig) if getattr(recipe.model, f.name) != getattr(paper_small(), f.name)
    ]
    assert len(different) == changes if name in TABLE_3 else different
    assert recipe.model.temporal_accumulation == 0 and recipe.loss == RECIPES["paper"](DataPlan()).loss


def test_cameras_are_matted_on_white_and_the_view_is_white_with_black_holes():
    views, incomplete = context(5), view(5)
    frame = replace(views.frame, mask=views.frame.mask.clone(), rgb=views.frame.rgb.clone())
    frame.mask[:, :20], frame.rgb[:, :, :20] = 0, 77
    shown = context_images(replace(views, frame=frame), paper()).channels
    assert torch.equal(shown[:, :3, :20], torch.ones_like(shown[:, :3, :20]))
    assert torch.allclose(
        shown[:, :3, 20:] * frame.mask[:, None, 20:], frame.rgb[:, :, 20:] / 255 * frame.mask[:, None, 20:]
    )
    mask = incomplete.mask.clone()
    mask[:10] = 0
    error = incomplete.error.clone()
    error[5:15, 5:15] = 1
    own = replace(incomplete, mask=mask, error=error, rgb=incomplete.rgb * mask)
    seen = target_images(own, own.rgb, paper())
    assert (seen.channels[0, :3, :5] == 1).all() and (seen.channels[0, :3, 5:15, 5:15] == 0).all()
    valid = (mask > 0) & (error == 0)
    assert torch.equal(seen.channels[0, :3, valid], own.rgb[:, valid])
    assert bool(seen.foreground[0, 5:10, 5:15].all()), "what is missing outside M is looked at, too"


def test_what_is_missing_outside_the_subject_is_filled():
    incomplete = view(5)
    error = torch.zeros_like(incomplete.error)
    error[2:8, 40:50] = 1
    alone = replace(
        incomplete, mask=incomplete.mask * 0, depth=incomplete.depth * 0, rgb=incomplete.rgb * 0, error=error
    )
    torch.manual_seed(0)
    net = build(paper_small()).eval()
    completed, _ = net.step(alone, Rig(), net.initial_state())
    assert (completed.rgb[:, error > 0] != 0).any() and not completed.rgb[:, error == 0].any()
    assert torch.equal(completed.alpha, error), "upon white, what was painted covers"


def test_the_start_is_not_a_copier():
    torch.manual_seed(0)
    nets = [build(replace(paper_small(), identity_init=start)) for start in (False, True)]
    biases = [float(net.transformer.keys_values.bias.detach().abs().max()) for net in nets]
    assert 0 < biases[0] < 0.2 and biases[1] > 1
    assert not any(isinstance(norm, torch.nn.LayerNorm) for norm in (nets[0].tokeniser.norm, nets[0].decoder.norm))


def test_training_prunes_straight_through_and_the_step_prunes_as_well(monkeypatch):
    seen = []
    monkeypatch.setattr(
        "viewmend.inpainting.transformer.straight_through",
        lambda received, keep, k: seen.append(k) or keep.to(received.dtype),
    )
    net = build(replace(paper_small(), top_k=3))
    net([view(5)], [[context(5)]])[0].inpainted.sum().backward()
    assert seen == [3, 3], "once a group"


def test_the_losses_are_literal():
    predicted, truth = torch.full((3, 4, 4), 0.5), torch.zeros(3, 4, 4)
    error = torch.zeros(4, 4)
    error[0] = 1
    loss = image_loss([predicted], [torch.ones(4, 4)], [error], [truth], "sum")
    assert float(loss.inside) == pytest.approx(1.5) and float(loss.outside) == pytest.approx(1.5)
    assert float(image_loss([predicted], [torch.ones(4, 4)], [error], [truth]).inside) == pytest.approx(0.5)


def test_the_fill_is_not_clamped_before_the_blend():
    known, half = torch.zeros(3, 2, 2), torch.full((2, 2), 0.5)
    assert float(blend(known, half, torch.full((3, 2, 2), 1.6), half, clamp=False).max()) == pytest.approx(0.8)
    assert float(blend(known, half, torch.full((3, 2, 2), 1.6), half).max()) == pytest.approx(0.5)


def test_a_centres_depth_is_the_mean_about_it():
    depth = torch.zeros(1, 28, 44)
    depth[0, 13:15, 13:15] = torch.tensor([[1.0, 2.0], [3.0, 6.0]])
    depth[0, 13, 30] = 4.0
    none = torch.zeros(1, 28, 44, dtype=torch.bool)
    assert patch_depths(depth, none, around=True).tolist() == [[[3.0, 4.0]]]
    assert patch_depths(depth, none).tolist() == [[[6.0, 0.0]]]


def test_three_cameras_are_looked_at_whatever_number_coloured_the_view():
    many = replace(view(5), source_views=("a", "b"), candidate_views=("a", "b", "c", "d"))
    assert PatchTransformer(paper_small()).context_names(many) == ("a", "b", "c")
    assert PatchTransformer(replace(small(), coarse_fill="none")).context_names(many) == ("a", "b")


def test_beyond_a_smaller_image_of_a_stack_there_is_no_white():
    views = context(5)
    cameras = views.frame.cameras
    size_px = cameras.size_px.clone()
    size_px[0, 0] -= 10
    frame = replace(views.frame, cameras=replace(cameras, size_px=size_px), mask=torch.zeros_like(views.frame.mask))
    shown = context_images(replace(views, frame=frame), paper()).channels
    assert not shown[0, :3, :, -10:].any() and (shown[0, :3, :, :-10] == 1).all() and (shown[1, :3] == 1).all()


def test_what_is_shipped_under_the_papers_name_is_the_papers_model_and_has_learned():
    net = load_network("paper-small")
    assert net.config == paper_small() and type(net) is PatchTransformer
    plan = replace(as_the_paper(DataPlan()), sizes_px=(224,), cameras=(8, 8), held_cameras=3, hull_resolution=64)
    samples = StudioScenes(replace(plan, imperfect_fraction=0.0, min_hole_px=200), "shipped", "validation").scene(0)
    squares = {"ours": [], "telea": []}
    for sample in samples:
        truth, judged = true_image(sample, "white"), (sample.view.error > 0) & (sample.alpha > 127)
        telea = UponWhite(Telea())
        nothing = ContextProvider(lambda tau, names: None)
        with torch.no_grad():
            made = net.eval()([sample.view], [list(sample.context)])[0].upon_own
        filled = telea.step(sample.view, nothing, telea.initial_state())[0].rgb
        for name, image in (("ours", made), ("telea", filled)):
            squares[name].append((image.clamp(0, 1) - truth).square()[:, judged].flatten())
    ours, telea = (-10 * torch.cat(found).mean().log10() for found in squares.values())
    assert ours > telea + 0.5, f"{ours:.2f} dB on the subject, Telea {telea:.2f}"
