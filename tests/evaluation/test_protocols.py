"""The protocols: what is known of the held-out camera, in the hull, the model's input and the completed view."""

from dataclasses import replace

import pytest
import torch
from models.plates import Rig, context, view
from reference.ball import BallCapture, camera_at, ring

from viewmend.geometry.hull import HullConfig
from viewmend.mending import Mender, default_protocol
from viewmend.models.base import RenderQuality
from viewmend.models.checkpoint import build, load_inpainter
from viewmend.models.classical import Telea
from viewmend.models.compositing import opaque_in_mask
from viewmend.models.paper.config import paper, paper_small
from viewmend.models.paper.tokenizer import build_context_input, build_target_input
from viewmend.models.smooth_fill import SmoothFill
from viewmend.rendering.view import RenderConfig, select_closest
from viewmend.scenes.held_out import LeaveOneOut, reveal
from viewmend.stream import Stream, StreamConfig
from viewmend.training.config import SamplingConfig
from viewmend.training.samples import HeldOutCamera
from viewmend.types import CompletedView, check_target_mask

TARGET = camera_at(75, "t", height_m=0.3)


def truth_with_half_a_mask():
    """What the target camera sees; its mask is soft at the edge, and shows the left half alone."""
    truth = BallCapture(TARGET, 1).read(0)
    mask = truth.mask.clone()
    mask[..., mask.shape[-1] // 2 :] = 0
    mask[..., mask.shape[-1] // 2] //= 2
    return replace(truth, mask=mask)


def mended(protocol, inpainter=None):
    mender = Mender(inpainter or SmoothFill(), protocol=protocol)
    return mender.mend(BallCapture(ring(6), 1).read(0), TARGET, truth_with_half_a_mask())


def test_with_the_target_mask_nothing_outside_of_it_is_painted():
    truth = truth_with_half_a_mask()
    mask = truth.mask[0].float() / 255
    strict, cut = mended("strict"), mended("target-mask")
    assert strict.completed.rgb[:, mask == 0].any() and strict.completed.view.target_mask is None
    assert torch.equal(cut.completed.view.target_mask, mask)
    assert torch.equal(cut.completed.view.rgb, strict.completed.view.rgb)
    torch.testing.assert_close(cut.completed.rgb, strict.completed.rgb * mask)
    torch.testing.assert_close(cut.completed.opacity, strict.completed.opacity * mask)
    known = cut.completed.view.error == 0
    assert torch.equal(cut.completed.rgb[:, known], cut.completed.view.cut_rgb[:, known])
    assert torch.equal(cut.rendered, strict.rendered * mask)
    assert cut.scores.ours.psnr_whole > strict.scores.ours.psnr_whole + 1
    assert cut.scores.ours.hole_px == strict.scores.ours.hole_px, "the same holes in every protocol"


class HalfTheSubject(SmoothFill):
    """Predicts that the right half of a view is background."""

    def step(self, view, context, state):
        completed, state = super().step(view, context, state)
        alpha = view.mask.clone()
        alpha[:, alpha.shape[1] // 2 :] = 0
        return replace(completed, alpha=alpha), state


def test_a_predicted_mask_cuts_the_view_and_the_truth_is_not_looked_at():
    mender = Mender(Telea(), protocol="predicted-mask", error_model=HalfTheSubject())
    frame = BallCapture(ring(6), 1).read(0)
    truth = truth_with_half_a_mask()
    step = mender.mend(frame, TARGET, truth)
    used = step.completed.view.target_mask
    assert used.any() and not used[:, used.shape[1] // 2 :].any()
    assert torch.equal(step.completed.opacity, step.completed.view.mask * used)
    assert not step.completed.rgb[:, used == 0].any()
    emptied = replace(truth, mask=truth.mask * 0)
    again = Mender(Telea(), protocol="predicted-mask", error_model=HalfTheSubject()).mend(
        frame, TARGET, emptied
    )
    assert torch.equal(again.completed.rgb, step.completed.rgb)
    assert reveal("predicted-mask", truth) == (None, None)


def test_a_model_that_needs_a_mask_gets_a_predicted_one():
    class NeedsMask(Telea):
        needs_mask = True

    frame = BallCapture(ring(6), 1).read(0)
    stream = Stream(NeedsMask(), error_model=HalfTheSubject())
    stream.add_frame(frame)
    view = stream.view(TARGET).completed
    used = view.view.target_mask
    assert used is not None and used.any() and not used[:, used.shape[1] // 2 :].any()
    mended_view = stream.mend(stream.render(TARGET)).completed
    assert torch.equal(mended_view.view.target_mask, used)
    assert torch.equal(mended_view.rgb, view.rgb)
    given = stream.view(TARGET, target_mask=torch.ones_like(used)).completed.view
    assert (given.target_mask[given.mask > 0] == 1).all()
    for quality in (
        RenderQuality(mend=False),
        RenderQuality(context_times=2),
        RenderQuality(refine_fraction=0.5),
    ):
        assert stream.view(TARGET, quality=quality).completed.view.target_mask is None, (
            "a mask costs too much"
        )
    strict = Stream(NeedsMask(), StreamConfig(predict_mask=False), error_model=HalfTheSubject())
    strict.add_frame(frame)
    assert strict.view(TARGET).completed.view.target_mask is None
    with pytest.raises(ValueError, match="turn it on"):
        strict.predict_mask(strict.render(TARGET))
    with pytest.raises(ValueError, match="predicts masks"):
        Stream(Telea(), StreamConfig(predict_mask=True))
    assert default_protocol(NeedsMask()) == "predicted-mask" and default_protocol(Telea()) == "strict"


def test_the_hull_with_the_target_mask_lies_inside_of_it():
    strict, carved = (mended(protocol).completed.view for protocol in ("strict", "hull-with-target-mask"))
    outside, whole = truth_with_half_a_mask().mask[0] == 0, int((strict.mask > 0).sum())
    assert carved.target_mask is None and int(((carved.mask > 0) & outside).sum()) < 0.05 * whole
    assert int(((strict.mask > 0) & outside).sum()) > 0.3 * whole


def test_classical_fills_see_the_uncut_view_and_are_cut_afterwards():
    seen = []

    class Spy(Telea):
        def step(self, view, context, state):
            seen.append(view)
            return super().step(view, context, state)

    cut = mended("target-mask", Spy())
    assert (
        torch.equal(seen[-1].rgb, cut.completed.view.rgb) and seen[-1].rgb[:, seen[-1].target_mask == 0].any()
    )


def test_outside_of_the_target_mask_there_is_neither_confidence_nor_depth():
    class Sure(Telea):
        def step(self, view, context, state):
            completed, state = super().step(view, context, state)
            return replace(completed, confidence=torch.ones_like(view.mask), depth=view.depth + 0.1), state

    for inpainter in (Sure(), Telea()):
        cut = mended("target-mask", inpainter).completed
        inside = cut.view.target_mask > 0
        assert int((cut.view.depth > 0)[~inside].sum()) > 50
        shown = cut.view.depth > 0 if cut.depth is None else torch.ones_like(inside)
        assert torch.equal(cut.surface_depth > 0, shown & inside)
        assert cut.confidence is None or torch.equal(cut.confidence, inside.float())


def test_the_papers_model_sees_m_t_white_where_it_is_0_and_black_where_it_is_missing():
    incomplete = view(5)
    mask = torch.ones_like(incomplete.mask)
    mask[:, :40] = 0
    error = torch.zeros_like(incomplete.error)
    error[10:30, 20:60] = 1
    given = replace(incomplete, error=error, target_mask=mask)
    own = build_target_input(given, paper())
    assert torch.equal(own.channels[0, 3], incomplete.mask * mask)
    assert (own.channels[0, :3, :, :40] == 1).all() and not own.channels[0, :3, 10:30, 40:60].any()
    assert not own.foreground[0, :, :40].any() and bool(own.foreground[0, 10:30, 40:60].all())
    net = build(paper_small()).eval()
    completed, _ = net.step_on("black", given, Rig(), net.initial_state())
    assert not completed.rgb[:, :, :40].any()
    assert torch.equal(completed.opacity, torch.maximum(incomplete.mask, error) * mask)
    assert (net([given], [[context(5)]])[0].composited[:, :, :40] == 1).all(), "training sees what is scored"


def test_what_the_target_mask_shows_is_opaque():
    """A model's own alpha is replaced in E; where it is too low to have a colour, the neighbours' colour is taken."""
    incomplete, error = view(5), torch.zeros_like(view(5).error)
    error[10:30, 20:60] = 1
    mask = error * torch.ones_like(error)
    mask[:12] = 0
    colour = torch.tensor([0.8, 0.4, 0.2])[:, None, None]
    alpha = torch.full_like(error, 0.5)
    alpha[14:20, 30:40] = 0
    given = replace(incomplete, error=error, target_mask=mask)
    completed = CompletedView(given, colour * alpha, alpha=alpha)
    made = opaque_in_mask(completed)
    known = (mask > 0) & (error > 0)
    assert (made.alpha[known] == 1).all() and torch.equal(made.alpha[~known], alpha[~known])
    torch.testing.assert_close(
        made.rgb[:, known], colour[:, 0].expand(3, int(known.sum())), atol=1e-3, rtol=0
    )
    assert torch.equal(made.rgb[:, ~known], completed.rgb[:, ~known])
    without = CompletedView(replace(given, target_mask=None), completed.rgb, alpha=alpha)
    assert opaque_in_mask(without) is without
    net = load_inpainter("views")
    seen = mended("target-mask", net).completed
    inside = (seen.view.target_mask == 1) & (seen.view.refine_mask > 0) & (seen.view.depth > 0)
    assert inside.any() and (seen.opacity[inside] == 1).all()


def test_without_masks_nothing_is_cut_and_no_patch_is_dropped():
    config = replace(paper_small(), use_mask=False)
    views, incomplete = context(5), view(5)
    frame = replace(views.frame, mask=torch.zeros_like(views.frame.mask))
    made = build_context_input(replace(views, frame=frame), config)
    assert torch.equal(made.channels[:, :3], views.frame.rgb.float() / 255) and bool(made.kept.all())
    given = replace(
        incomplete, mask=torch.zeros_like(incomplete.mask), target_mask=torch.zeros_like(incomplete.mask)
    )
    target = build_target_input(given, config)
    assert torch.equal(target.channels[0, :3], incomplete.rgb) and bool(target.kept.all())
    assert made.channels.shape[1] == 4, "RGB and depth"


def test_a_target_mask_that_overshoots_is_clamped():
    stream = Stream(Telea())
    stream.add_frame(BallCapture(ring(6), 1).read(0))
    mask = torch.ones(stream.render(TARGET).mask.shape)
    mask[:, 20:24], mask[:, 24:28] = 1.2, -0.2
    exact = stream.view(TARGET, target_mask=mask.clamp(0, 1)).completed
    for own in (
        stream.view(TARGET, target_mask=mask),
        stream.mend(replace(stream.render(TARGET), target_mask=mask)),
    ):
        assert torch.equal(own.completed.rgb, exact.rgb) and torch.equal(own.completed.opacity, exact.opacity)


def test_a_wrong_target_mask_is_refused():
    source = BallCapture(ring(6), 1).read(0)
    stream = Stream(SmoothFill())
    stream.add_frame(source)
    rendered = stream.render(TARGET)
    for mask, got in (
        (torch.ones(3, 4), r"\(3, 4\); give the mask of this view"),
        (torch.full(rendered.mask.shape, 255.0), "values from 255 to 255; divide"),
        (torch.ones(rendered.mask.shape, dtype=torch.uint8), r"torch.uint8; convert it with .float\(\)"),
        (rendered.mask.double(), r"torch.float64; convert it with .float\(\)"),
        (rendered.mask.numpy(), "ndarray; convert it with torch.as_tensor"),
    ):
        with pytest.raises(ValueError, match=f"expected target_mask .* got {got}"):
            check_target_mask(mask, rendered.mask.shape)
    with pytest.raises(ValueError, match=r"of shape \(48, 48\), got \(3, 4\); give the mask of this view"):
        stream.view(TARGET, target_mask=torch.ones(3, 4))
    with pytest.raises(ValueError, match="values from 255 to 255"):
        stream.mend(replace(rendered, target_mask=torch.full(rendered.mask.shape, 255.0)))


def test_a_view_of_another_renderer_may_have_a_target_mask():
    stream = Stream(SmoothFill())
    stream.add_frame(BallCapture(ring(6), 1).read(0))
    rendered = stream.render(TARGET)
    mask = (torch.arange(rendered.mask.shape[1]) < 30).float().expand_as(rendered.mask).contiguous()
    made = stream.mend(replace(rendered, target_mask=mask)).completed
    assert not made.rgb[:, :, 30:].any() and not made.opacity[:, 30:].any() and made.rgb.any()


def test_training_samples_follow_the_protocol():
    source = BallCapture(ring(6), 1)
    held = source.read(0).cameras.names[0]
    samples = {}
    for protocol in ("strict", "target-mask", "hull-with-target-mask"):
        camera = HeldOutCamera(LeaveOneOut({0: source.read(0)}), held, HullConfig(resolution=48), protocol)
        samples[protocol] = camera.sample(0, (0,), RenderConfig(), SamplingConfig())
    truth = source.read(0).select([held])
    assert torch.equal(samples["target-mask"].view.target_mask, truth.mask[0].float() / 255)
    assert samples["strict"].view.target_mask is samples["hull-with-target-mask"].view.target_mask is None
    outside = {name: int((s.view.mask[truth.mask[0] == 0] > 0).sum()) for name, s in samples.items()}
    assert outside["hull-with-target-mask"] < outside["strict"] == outside["target-mask"]
    assert reveal("strict", truth) == (None, None)


def test_views_are_selected_by_angle_or_by_direction():
    target, cameras = camera_at(0, "t"), ring(7)
    centre = torch.zeros(3)
    by_angle = select_closest(target, cameras, centre, 3)
    pose = cameras.camera_from_world.clone()
    first = cameras.names.index(by_angle[0])
    pose[first] = (
        torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ pose[first]
    )  # the closest camera looks away
    away = replace(cameras, camera_from_world=pose)
    assert select_closest(target, away, centre, 7) == select_closest(target, cameras, centre, 7)
    assert select_closest(target, away, centre, 7, "direction")[-1] == by_angle[0]
    with pytest.raises(
        ValueError, match="expected a selection of views by 'angle' or 'direction', got 'colour'"
    ):
        RenderConfig(selection="colour")
