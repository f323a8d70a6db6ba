"""The scores of a case made by hand, and the ways they are computed."""

import math
from dataclasses import replace

import pytest
import torch

from viewmend.evaluation.frame_scores import Before, Scorers, TrueView, score_frame, similarity, true_view
from viewmend.geometry.cameras import Cameras
from viewmend.metrics.image_quality import ssim_map
from viewmend.views import CompletedView, IncompleteView, MultiViewFrame

HEIGHT, WIDTH = 40, 50


@pytest.fixture
def case():
    """A grey truth of 0.5; ours has 0.6 in a hole of 10 x 10, and 0.9 in the half of it that is background (black)."""
    rgb, error = torch.full((3, HEIGHT, WIDTH), 0.5), torch.zeros(HEIGHT, WIDTH)
    error[10:20, 20:30] = 1
    truth, mask = rgb.clone(), torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    mask[10:20, 25:30] = False
    truth[:, ~mask] = 0
    ours = rgb.clone()
    ours[:, 10:20, 20:25], ours[:, 10:20, 25:30] = 0.6, 0.9
    camera = Cameras(("c",), torch.eye(3)[None], torch.eye(4)[None], torch.tensor([[WIDTH, HEIGHT]]))
    view = IncompleteView(
        camera, rgb * (error == 0), torch.ones(HEIGHT, WIDTH), error, torch.ones(HEIGHT, WIDTH), (),
        (error == 0).float()[None], 7,
    )  # fmt: skip
    return CompletedView(view, ours), TrueView(truth, mask, None)


def decibel(squared: float) -> float:
    return -10 * math.log10(squared)


def test_by_hand(case):
    scores = score_frame(*case, None, 12.5)
    assert (scores.time, scores.width_px, scores.height_px, scores.image_px) == (7, WIDTH, HEIGHT, 2000)
    assert (scores.hull_px, scores.hole_px, scores.hole_fg_px, scores.step_ms) == (2000, 100, 50, 12.5)
    squared = (0.01 + 0.81) / 2
    assert scores.psnr_holes == pytest.approx(decibel(squared), abs=1e-4)
    assert scores.psnr_holes_fg == pytest.approx(20, abs=1e-4)
    assert scores.psnr_masked == pytest.approx(decibel(squared * 100 / 2000), abs=1e-4)  # the hole's share lifts it
    assert scores.psnr_whole == pytest.approx(scores.psnr_masked)
    assert scores.flicker is scores.change is scores.lpips_alex_whole is None


def test_the_whole_view_is_scored_beside_what_was_rendered(case):
    completed, truth = case
    scores = score_frame(completed, truth, None, 1.0)
    assert scores.psnr_whole_rendered == pytest.approx(decibel(50 * 0.25 / 2000), abs=1e-4)
    assert scores.psnr_subject == pytest.approx(decibel(50 * 0.01 / 1950), abs=1e-4)
    assert scores.alpha_iou == pytest.approx(1950 / 2000)  # M, where nothing is told
    alpha = torch.where(truth.mask, 0.51, 0.49)
    alpha[0] = 0.2
    assert score_frame(replace(completed, alpha=alpha), truth, None, 1.0).alpha_iou == pytest.approx(1900 / 1950)


def test_holes_are_the_same_by_every_error_rule(case):
    completed, truth = case
    everything = replace(completed.view, error=completed.view.mask)
    assert score_frame(replace(completed, view=everything), truth, None, 1.0) == score_frame(*case, None, 1.0)


def test_ssim_of_each_reading(case):
    completed, truth = case
    scores = score_frame(completed, truth, None, 1.0)
    holes = completed.view.error > 0
    seen = ssim_map(completed.rgb, truth.rgb)
    masked = ssim_map(completed.rgb * holes, truth.rgb * holes)
    assert seen is not None
    assert scores.ssim_whole == pytest.approx(float(seen.mean()), abs=1e-12)
    assert scores.ssim_holes == pytest.approx(float(seen[5:15, 15:25].mean()), abs=1e-12)
    assert scores.ssim_holes_fg == pytest.approx(float(seen[5:15, 15:20].mean()), abs=1e-12)
    assert scores.ssim_masked == pytest.approx(float(masked.mean()), abs=1e-12)


def test_no_hole_has_no_score_in_holes(case):
    completed, truth = case
    view = replace(completed.view, error=torch.zeros(HEIGHT, WIDTH), weights=torch.ones(1, HEIGHT, WIDTH))
    scores = score_frame(CompletedView(view, truth.rgb), truth, None, 1.0)
    assert scores.psnr_holes is scores.psnr_masked is scores.ssim_holes is scores.ssim_masked is None
    assert scores.ssim_whole == 1 and scores.psnr_whole == 100


def test_other_scores_come_through_their_maps(case):
    def score(image, truth):
        return (image - truth).abs().mean(0)

    scores = score_frame(*case, None, 1.0, Scorers(lpips_alex=score, lpips_vgg=lambda image, truth: None))
    assert scores.lpips_alex_holes == pytest.approx(0.5)
    assert scores.lpips_alex_holes_fg == pytest.approx(0.1)
    assert scores.lpips_alex_whole == pytest.approx(scores.lpips_alex_masked) == pytest.approx(0.5 * 100 / 2000)
    assert scores.lpips_vgg_whole is scores.lpips_vgg_holes is None


@pytest.mark.parametrize("window", ["gaussian", "uniform7"])
@pytest.mark.parametrize("where", [(0, 1, 0, 1), (36, 40, 44, 50), (0, 40, 0, 50), (5, 20, 30, 31)])
def test_computing_only_where_images_differ_gives_the_same(rng, window, where):
    truth = torch.rand(3, HEIGHT, WIDTH, generator=rng)
    top, bottom, left, right = where
    image = truth.clone()
    image[:, top:bottom, left:right] = 0.3
    expected, got = ssim_map(image, truth, window), similarity(image, truth, window)
    assert expected is not None and got is not None
    inner = got[got.isfinite()].view(expected.shape)
    torch.testing.assert_close(inner, expected, rtol=0, atol=1e-12)


@pytest.fixture
def moving(rng):
    """A texture that moves 3 pixels to the right and 1 down, in two frames, and where each pixel came from."""
    texture = torch.rand(3, HEIGHT + 1, WIDTH + 3, generator=rng)
    before, now = texture[:, 1:, 3:], texture[:, :-1, :-3]
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    source = torch.stack([x - 3, y - 1], -1)
    inside = (source > 0).all(-1)
    return before, now, torch.where(inside[..., None], source, torch.nan)


def temporal(case, moving, ours_before, ours_now):
    before, now, source = moving
    completed, truth = case
    view = completed.view
    return score_frame(
        CompletedView(view, ours_now), TrueView(now, truth.mask, source), Before(ours_before, before, view.holes), 1.0
    )


def test_a_perfect_stream_flickers_not_at_all(case, moving):
    before, now, _ = moving
    scores = temporal(case, moving, before, now)
    assert scores.flicker == 0
    assert scores.warp_error == scores.warp_error_truth == pytest.approx(0, abs=1e-6)
    assert scores.change == scores.change_truth > 0.1


def test_what_changes_where_the_truth_stands_still_is_told(case):
    completed, truth = case
    still = torch.zeros(3, HEIGHT, WIDTH)
    still[:, :, : WIDTH // 2] = 0.5
    then, now = truth.rgb, truth.rgb + still
    before = Before(completed.rgb, then, completed.view.holes)
    other = replace(completed, rgb=completed.rgb + 0.2)
    assert score_frame(other, replace(truth, rgb=now), before, 1.0).change_still == pytest.approx(0.2, abs=1e-6)
    moves = replace(completed, rgb=completed.rgb + still)
    assert score_frame(moves, replace(truth, rgb=now), before, 1.0).change_still == pytest.approx(0, abs=1e-6)
    assert score_frame(completed, truth, None, 1.0).change_still is None


def test_an_error_that_moves_with_the_surface_does_not_flicker_and_one_that_stays_does(case, moving):
    before, now, _ = moving
    assert temporal(case, moving, before + 0.1, now + 0.1).flicker == pytest.approx(0, abs=1e-6)
    assert temporal(case, moving, before, now + 0.1).flicker == pytest.approx(0.1, abs=1e-6)
    beside = now.clone()
    beside[:, ~case[0].view.holes] += 0.1  # what is coloured, alone
    assert temporal(case, moving, before, beside).flicker == pytest.approx(0, abs=1e-6)
    whole = temporal(case, moving, before, beside).flicker_whole
    assert 0.08 < whole < 0.1, "over all that shows, holes included"
    stuck = temporal(case, moving, before, before)
    assert stuck.change == 0 and stuck.flicker > 0.1 and stuck.warp_error == pytest.approx(stuck.flicker, abs=1e-6)


def test_the_change_is_over_the_holes_of_both_times(case):
    completed, truth = case
    then = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    then[25:35, 20:30] = True  # as many pixels as this time's holes, elsewhere
    shown = completed.rgb.clone()
    shown[:, then] += 0.3
    scores = score_frame(completed, truth, Before(shown, truth.rgb, then), 1.0)
    assert scores.change == pytest.approx(0.15, abs=1e-6) and scores.change_truth == 0


def test_the_truth_is_black_where_its_mask_is(case):
    mask = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.uint8)
    mask[0, :, 10:], mask[0, :, 30:] = 51, 255
    rgb = torch.full((1, 3, HEIGHT, WIDTH), 200, dtype=torch.uint8)
    truth = true_view(MultiViewFrame(case[0].view.camera, rgb, mask, 0), None)
    for columns, share in ((slice(10), 0.0), (slice(10, 30), 0.2), (slice(30, None), 1.0)):
        expected = torch.tensor(200 / 255 * share)
        assert torch.allclose(truth.rgb[:, :, columns], expected, atol=1e-6)
        assert bool((truth.mask[:, columns] == (share > 0.5)).all())
