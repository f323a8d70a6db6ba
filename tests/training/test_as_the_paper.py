"""`paper()` against a checklist made from the specification, by its sections."""

from dataclasses import asdict, replace

import torch
from models.plates import Rig, context, view

from viewmend.models.base import ContextProvider
from viewmend.models.checkpoint import build, load_network
from viewmend.models.classical import Telea
from viewmend.models.compositing import composite
from viewmend.models.paper.config import paper, paper_small
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.paper.tokenizer import build_context_input, build_target_input
from viewmend.training.config import SceneConfig
from viewmend.training.paper import SAMPLING
from viewmend.training.samples import true_image
from viewmend.training.scenes import SampleScenes, StudioRigs

CHECKLIST = {
    **{"n_c": 3, "n_w": 3, "k_w": 10},  # section 2
    "num_source_views": 3,  # 2, 13: exactly three cameras
    "widths": (64, 64, 128, 256, 384, 512, 384, 256, 128),  # 3: FuseFormer's
    **{"use_mask": True, "use_depth": True},  # 3: both are inputs
    **{"dim": 512, "heads": 8, "groups": 2, "blocks": 4, "ffn_ratio": 4, "rope": True},  # 6
    "top_k": 512,  # 6: the paper leaves it open
    "background": "white",  # 13
}


def test_the_model_is_the_papers_and_paper_small_differs_in_widths_only():
    assert asdict(paper()) == CHECKLIST
    assert paper().in_channels == 5, "RGB, mask and pseudo depth"
    sizes = {name: getattr(paper(), name) for name in ("widths", "dim", "heads")}
    assert replace(paper_small(), **sizes) == paper()


def test_images_are_on_white_and_holes_are_black():
    views, incomplete = context(5), view(5)
    frame = replace(views.frame, mask=views.frame.mask.clone(), rgb=views.frame.rgb.clone())
    frame.mask[:, :20], frame.rgb[:, :, :20] = 0, 77
    shown = build_context_input(replace(views, frame=frame), paper()).channels
    assert torch.equal(shown[:, :3, :20], torch.ones_like(shown[:, :3, :20]))
    inside = frame.mask[:, None, 20:]
    assert torch.allclose(shown[:, :3, 20:] * inside, frame.rgb[:, :, 20:] / 255 * inside)
    mask, error = incomplete.mask.clone(), incomplete.error.clone()
    mask[:10], error[5:15, 5:15] = 0, 1
    own = replace(incomplete, mask=mask, error=error, rgb=incomplete.rgb * mask)
    seen = build_target_input(own, paper())
    assert (seen.channels[0, :3, :5] == 1).all() and (seen.channels[0, :3, 5:15, 5:15] == 0).all()
    valid = (mask > 0) & (error == 0)
    assert torch.equal(seen.channels[0, :3, valid], own.rgb[:, valid])
    assert bool(seen.foreground[0, 5:10, 5:15].all()), "holes outside of M are encoded, too"


def test_holes_outside_the_subject_are_filled():
    own = view(5)
    error = torch.zeros_like(own.error)
    error[2:8, 40:50] = 1
    alone = replace(own, mask=own.mask * 0, depth=own.depth * 0, rgb=own.rgb * 0, error=error)
    torch.manual_seed(0)
    net = build(paper_small()).eval()
    completed, _ = net.step(alone, Rig(), net.initial_state())
    assert (completed.rgb[:, error > 0] != 0).any() and not completed.rgb[:, error == 0].any()
    assert torch.equal(completed.alpha, error), "on white, painted pixels are opaque"


def test_three_cameras_are_context_however_many_coloured_the_view():
    many = replace(view(5), source_views=("a", "b"), candidate_views=("a", "b", "c", "d"))
    assert PatchTransformer(paper_small()).source_names(many) == ("a", "b", "c")


def test_padding_is_not_white():
    views = context(5)
    cameras, size_px = views.frame.cameras, views.frame.cameras.size_px.clone()
    size_px[0, 0] -= 10
    frame = replace(
        views.frame, cameras=replace(cameras, size_px=size_px), mask=torch.zeros_like(views.frame.mask)
    )
    shown = build_context_input(replace(views, frame=frame), paper()).channels
    assert (
        not shown[0, :3, :, -10:].any() and (shown[0, :3, :, :-10] == 1).all() and (shown[1, :3] == 1).all()
    )


def test_the_shipped_model_is_the_papers_and_beats_telea_on_the_subject():
    net = load_network("paper-small")
    assert net.config == paper_small() and type(net) is PatchTransformer
    flawless = SceneConfig(sizes_px=(224,), cameras=(8, 8), num_holdout_views=3, imperfect_fraction=0.0)
    scenes = replace(flawless, hull_resolution=64)
    sampling, telea = replace(SAMPLING, min_hole_px=200), Telea()
    samples = SampleScenes(
        StudioRigs(scenes, sampling.frames, "shipped", "validation"), scenes, sampling
    ).scene(0)
    squares = {"model": [], "telea": []}
    for sample in samples:
        truth, compared = true_image(sample, "white"), (sample.view.error > 0) & (sample.alpha > 127)
        nothing = ContextProvider(lambda tau, names: None)
        with torch.no_grad():
            made = net.eval()([sample.view], [list(sample.context)])[0].composited
        filled = telea.step_on("white", sample.view, nothing, telea.initial_state())[0]
        for name, image in (("model", made), ("telea", composite("white", filled.rgb, filled.opacity))):
            squares[name].append((image.clamp(0, 1) - truth).square()[:, compared].flatten())
    own, classical = (-10 * torch.cat(found).mean().log10() for found in squares.values())
    assert own > classical + 0.5, f"{own:.2f} dB on the subject, Telea {classical:.2f}"
