"""What `mend` says of its views: each figure under its own name, of its own time, against a truth on black."""

from dataclasses import fields, replace

import pytest
import torch
from reference.ball import BallCapture, camera_at, ring

from viewmend.evaluation.mending import Mender, MendSummary, Scores
from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.metrics.view_scores import ViewScores

TARGET = camera_at(75, "t", height_m=0.3)


def numbered(first):
    """Scores that are all different."""
    names = [field.name for field in fields(ViewScores)]
    return ViewScores(**{n: first + k if n.endswith("_px") else float(first + k) for k, n in enumerate(names)})


def test_every_figure_stands_under_its_own_name():
    summary = MendSummary()
    fills = {name: numbered(100 * n) for n, name in enumerate(("unfilled", "telea", "unseen", "ours"), 1)}
    summary._scores.append(Scores(**fills, **{f.name: 0.5 for f in fields(Scores) if f.name not in fills}))
    report = summary.as_json()
    for kind in ("holes", "holes_fg"):
        assert report[f"psnr_{kind}_telea"] == getattr(fills["telea"], f"psnr_{kind}")
    for kind in ("whole", "subject", "valid", "holes", "holes_fg"):
        assert report[f"psnr_{kind}"] == getattr(fills["ours"], f"psnr_{kind}")
    assert report["psnr_whole_unseen"] == fills["unseen"].psnr_whole
    assert report["psnr_whole_rendered"] == fills["unfilled"].psnr_whole


def test_each_time_is_seen_by_itself():
    source, mender = BallCapture(ring(6), 3), Mender(SmoothFill())
    means = [float(mender.mend(source.read(time), TARGET, None).completed.rgb.mean()) for time in range(3)]
    dimmed = [float(source.read(time).rgb.float().mean()) for time in range(3)]
    assert [m / means[0] for m in means] == pytest.approx([d / dimmed[0] for d in dimmed], abs=0.02)
    assert means[2] < 0.9 * means[0]


def test_the_truth_is_black_where_its_mask_is():
    source = BallCapture(ring(6), 1)
    truth = BallCapture(TARGET, 1).read(0)
    bright = replace(truth, rgb=torch.where(truth.mask[:, None] > 127, truth.rgb, 255).to(torch.uint8))
    steps = [Mender(SmoothFill()).mend(source.read(0), TARGET, seen) for seen in (truth, bright)]
    assert steps[0].scores == steps[1].scores and float(steps[1].truth[:, 0, 0].max()) == 0
