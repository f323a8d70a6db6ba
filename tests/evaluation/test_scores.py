"""Scores of a view computed by hand, and the features of videos."""

import math
from dataclasses import replace

import pytest
import torch

from viewmend.evaluation import scores as module
from viewmend.evaluation.averages import tables, vfid
from viewmend.evaluation.paper_tables import PaperRow, paper_grid
from viewmend.evaluation.report import main_grid, make_report
from viewmend.evaluation.result_cache import CellStore
from viewmend.evaluation.runner import run_evaluation
from viewmend.evaluation.scene_run import RunSettings
from viewmend.evaluation.scores import (
    CLIP_FRAMES,
    KINDS,
    PreviousView,
    Scorers,
    TrueView,
    VideoFeatures,
    available_networks,
    score_view,
    true_view,
)
from viewmend.geometry.cameras import Cameras
from viewmend.metrics.image_quality import ssim_map
from viewmend.metrics.vfid import I3d, frechet_distance, video_features
from viewmend.types import CompletedView, IncompleteView, MultiViewFrame
from viewmend.utils.weight_files import MissingWeightsError

HEIGHT, WIDTH = 40, 50
SSIM = Scorers()


@pytest.fixture
def case():
    """A grey truth of 0.5; the completed view has 0.6 in a hole of 10 x 10, and 0.9 in its half of background."""
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
    return CompletedView(view, ours), TrueView(truth, mask)


def decibel(squared: float) -> float:
    return -10 * math.log10(squared)


def test_scores_match_hand_computed_values(case):
    scores = score_view(*case, SSIM)
    assert (scores.time, scores.width_px, scores.height_px, scores.image_px) == (7, WIDTH, HEIGHT, 2000)
    assert (scores.hull_px, scores.hole_px, scores.hole_fg_px) == (2000, 100, 50)
    squared = (0.01 + 0.81) / 2
    assert scores.psnr_holes == pytest.approx(decibel(squared), abs=1e-4)
    assert scores.psnr_holes_fg == pytest.approx(20, abs=1e-4)
    assert scores.psnr_masked == pytest.approx(
        decibel(squared * 100 / 2000), abs=1e-4
    )  # the hole's share lifts it
    assert scores.psnr_whole == pytest.approx(scores.psnr_masked)
    assert scores.psnr_valid == 100
    assert scores.psnr_whole_rendered == pytest.approx(decibel(50 * 0.25 / 2000), abs=1e-4)
    assert scores.psnr_subject == pytest.approx(decibel(50 * 0.01 / 1950), abs=1e-4)
    assert scores.alpha_iou == scores.hull_iou == pytest.approx(1950 / 2000), (
        "M stands in for a missing alpha"
    )
    assert scores.flicker is scores.change_still is scores.lpips_alex_whole is None
    completed, truth = case
    alpha = torch.where(truth.mask, 0.51, 0.49)
    alpha[0] = 0.2
    assert score_view(replace(completed, alpha=alpha), truth, SSIM).alpha_iou == pytest.approx(1900 / 1950)


def test_holes_do_not_depend_on_the_error_rule(case):
    completed, truth = case
    everything = replace(completed.view, error=completed.view.mask)
    assert score_view(replace(completed, view=everything), truth, SSIM) == score_view(*case, SSIM)


@pytest.mark.parametrize("background", ["black", "white"])
def test_colours_beyond_the_range_are_scored_as_they_are_shown(case, background):
    """Networks may overshoot 0 and 1; image files do not."""
    completed, truth = case
    beyond = completed.rgb + torch.linspace(-0.9, 0.8, WIDTH)
    scored, shown = (
        score_view(replace(completed, rgb=rgb), truth, Scorers(background))
        for rgb in (beyond, beyond.clamp(0, 1))
    )
    assert scored == shown


def test_ssim_of_each_reading(case):
    completed, truth = case
    scores = score_view(completed, truth, SSIM)
    holes = completed.view.error > 0
    seen = ssim_map(completed.rgb, truth.rgb)
    masked = ssim_map(completed.rgb * holes, truth.rgb * holes)
    assert scores.ssim_whole == pytest.approx(float(seen.nanmean()), abs=1e-12)
    assert scores.ssim_holes == pytest.approx(float(seen[10:20, 20:30].mean()), abs=1e-12)
    assert scores.ssim_holes_fg == pytest.approx(float(seen[10:20, 20:25].mean()), abs=1e-12)
    assert scores.ssim_masked == pytest.approx(float(masked.nanmean()), abs=1e-12)


def test_a_view_without_holes_has_no_score_in_them(case):
    completed, truth = case
    view = replace(completed.view, error=torch.zeros(HEIGHT, WIDTH), weights=torch.ones(1, HEIGHT, WIDTH))
    scores = score_view(CompletedView(view, truth.rgb), truth, SSIM)
    assert scores.psnr_holes is scores.psnr_masked is scores.ssim_holes is scores.ssim_masked is None
    assert scores.ssim_whole == 1 and scores.psnr_whole == 100


def test_scores_of_networks_are_read_from_their_maps(case):
    def score(image, truth):
        return (image - truth).abs().mean(0)

    scores = score_view(*case, Scorers(ssim=None, lpips_alex=score, lpips_vgg=lambda image, truth: None))
    assert scores.lpips_alex_holes == pytest.approx(0.5)
    assert scores.lpips_alex_holes_fg == pytest.approx(0.1)
    assert (
        scores.lpips_alex_whole == pytest.approx(scores.lpips_alex_masked) == pytest.approx(0.5 * 100 / 2000)
    )
    assert scores.lpips_vgg_whole is scores.lpips_vgg_holes is scores.ssim_whole is None


@pytest.fixture
def moving(rng):
    """Two frames of a texture that moves 3 pixels right and 1 down, and the backward flow."""
    texture = 0.8 * torch.rand(3, HEIGHT + 1, WIDTH + 3, generator=rng)
    before, now = texture[:, 1:, 3:], texture[:, :-1, :-3]
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    source = torch.stack([x - 3, y - 1], -1)
    return before, now, torch.where((source > 0).all(-1)[..., None], source, torch.nan)


def temporal(case, moving, ours_before, ours_now):
    before, now, source = moving
    completed, truth = case
    view = completed.view
    previous = PreviousView(ours_before, before)
    return score_view(CompletedView(view, ours_now), TrueView(now, truth.mask, source), SSIM, previous)


def test_flicker_is_error_that_does_not_move_with_the_surface(case, moving):
    before, now, _ = moving
    assert temporal(case, moving, before + 0.1, now + 0.1).flicker == pytest.approx(0, abs=1e-6)
    assert temporal(case, moving, before, now + 0.1).flicker == pytest.approx(0.1, abs=1e-6)
    outside = now.clone()
    outside[:, ~case[0].view.holes] += 0.1
    assert temporal(case, moving, before, outside).flicker == pytest.approx(0, abs=1e-6)
    assert 0.08 < temporal(case, moving, before, outside).flicker_whole < 0.1, (
        "over everything, holes included"
    )
    assert temporal(case, moving, before, before).flicker > 0.1


def test_change_where_the_truth_is_still(case):
    completed, truth = case
    still = torch.zeros(3, HEIGHT, WIDTH)
    still[:, :, : WIDTH // 2] = 0.1
    then, now = truth.rgb, replace(truth, rgb=truth.rgb + still)
    previous = PreviousView(completed.rgb, then)
    for added, expected in ((0.1, 0.1), (still, 0.0)):
        scores = score_view(replace(completed, rgb=completed.rgb + added), now, SSIM, previous)
        assert scores.change_still == pytest.approx(expected, abs=1e-6)
    assert score_view(completed, truth, SSIM).change_still is None


@pytest.mark.parametrize("background", ["black", "white"])
def test_the_truth_is_composited_by_its_mask(case, background):
    mask = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.uint8)
    mask[0, :, 10:], mask[0, :, 30:] = 51, 255
    rgb = torch.full((1, 3, HEIGHT, WIDTH), 200, dtype=torch.uint8)
    truth = true_view(MultiViewFrame(case[0].view.camera, rgb, mask, 0), background)
    for columns, share in ((slice(10), 0.0), (slice(10, 30), 0.2), (slice(30, None), 1.0)):
        expected = torch.tensor(200 / 255 * share + (background == "white") * (1 - share))
        assert torch.allclose(truth.rgb[:, :, columns], expected, atol=1e-6)
        assert bool((truth.mask[:, columns] == (share > 0.5)).all())


@pytest.fixture(scope="module")
def i3d():
    torch.manual_seed(0)
    return I3d().eval()


@pytest.fixture
def networks(monkeypatch, i3d):
    def missing(device):
        raise MissingWeightsError("no file")

    def difference(device):
        return lambda image, truth: (image - truth).abs().mean(0)

    table = {
        "lpips-alex": ("lpips_alex", difference),
        "lpips-vgg": ("lpips_vgg", missing),
        "i3d": ("i3d", lambda d: i3d),
    }
    monkeypatch.setattr(module, "NETWORKS", table)


def test_networks_without_weights_are_left_out_with_a_reason(networks):
    assert available_networks() == (("lpips-alex", "i3d"), {"lpips-vgg": "no file"})


def test_streams_are_cut_into_videos(i3d, rng):
    frames = torch.rand(CLIP_FRAMES + 8, 3, 40, 44, generator=rng)
    holes = torch.rand(40, 44, generator=rng) > 0.5
    videos, shorter = VideoFeatures(i3d), VideoFeatures(i3d)
    for number, frame in enumerate(frames):
        videos.add(frame, holes)
        if number < CLIP_FRAMES + 1:
            shorter.add(frame, holes)
    found = videos.features()
    assert {len(v) for v in (shorter.features() or {}).values()} == {1}, "a single frame is no second video"
    assert found is not None and {kind: len(v) for kind, v in found.items()} == dict.fromkeys(KINDS, 2)
    expected = video_features(i3d, list(frames[CLIP_FRAMES:] * holes), "train")
    torch.testing.assert_close(torch.from_numpy(found["masked_train"][1]), expected)
    expected = video_features(i3d, list(frames[:CLIP_FRAMES]), "eval")
    torch.testing.assert_close(torch.from_numpy(found["whole_eval"][0]), expected)
    assert VideoFeatures(None).features() is None


def test_cells_store_features_and_tables_have_vfid(networks, small_scenes, tmp_path):
    methods, settings = ("telea", "unfilled"), RunSettings(networks=("lpips-alex", "i3d"))

    def run():
        steps = run_evaluation(small_scenes[:2], methods, CellStore(tmp_path), settings)
        return sorted((cell for found in steps for cell in found), key=lambda c: (c.key.scene, c.key.method))

    cells, again = run(), run()
    assert all(
        frame.lpips_alex_holes > 0 and frame.lpips_vgg_holes is None for c in cells for frame in c.frames
    )
    for first, second in zip(cells, again, strict=True):
        assert all((first.features[kind] == second.features[kind]).all() for kind in KINDS)
        assert all((first.true_features[kind] == second.true_features[kind]).all() for kind in KINDS)
    (table,) = tables(again, methods)
    own = [c for c in cells if c.key.method == "telea"]
    sides = [
        torch.from_numpy(getattr(c, name)["whole_eval"])
        for name in ("features", "true_features")
        for c in own
    ]
    expected = frechet_distance(torch.cat(sides[:2]), torch.cat(sides[2:]))
    assert table.rows[0].vfid["whole_eval"] == pytest.approx(expected) and expected > 0
    shown = dict(zip(main_grid(table).heads, main_grid(table).rows[0], strict=True))
    assert shown["VFID"] == f"{expected:.4f}" and float(shown["LPIPS whole"]) > 0
    grid = paper_grid([PaperRow("Telea", "telea")], make_report(again, methods, settings), {})
    assert dict(zip(grid.heads, grid.rows[0], strict=True))["VFID (here)"] == f"{expected:.4f}"
    assert vfid(cells[:1])["whole_eval"] is None, "a single video"
    for path in tmp_path.glob("*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    assert tables(run(), methods)[0].rows[0].vfid["whole_eval"] is None
