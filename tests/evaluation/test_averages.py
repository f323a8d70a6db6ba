"""From frames to tables, against plain loops."""

import statistics
from dataclasses import fields

import pytest
import torch

from viewmend.evaluation.averages import gains, speed, tables, tables_by_kind
from viewmend.evaluation.frame_scores import Scores
from viewmend.evaluation.records import records

METHODS = ("ours", "telea")


@pytest.fixture
def cells(make_cell, make_frame, rng):
    """Two sets of two and three scenes, random scores, some thin and empty frames, one failed cell."""

    def number(high: float = 1.0) -> float:
        return high * float(torch.rand((), generator=rng))

    def frame(method: str, hole_px: int):
        inside = hole_px // 2
        scores = {"psnr_holes": number(30) if hole_px else None, "psnr_holes_fg": number(30) if inside else None}
        return make_frame(hole_px=hole_px, hole_fg_px=inside, psnr_whole=number(30), step_ms=number(9), **scores)

    found = []
    for scene, (name, holes) in enumerate(
        [("A", [60, 40, 200]), ("A", [10, 0]), ("B", [100]), ("B", [300, 99]), ("B", [51])]
    ):
        for method in METHODS:
            failed = (scene, method) == (3, "ours")
            frames = [] if failed else [frame(method, px) for px in holes]
            found.append(make_cell(f"s{scene}", method, name, frames, "broke" if failed else None))
    return found


def twin(cells, method, score, enough, pixels="hole_px"):
    """The mean over frames with enough pixels, then over scenes that have any."""
    means = []
    for cell in cells:
        if cell.key.method == method:
            values = [getattr(f, score) for f in cell.frames if getattr(f, pixels) >= enough]
            if values:
                means.append(sum(values) / len(values))
    return sum(means) / len(means) if means else None


def test_tables_are_means_of_frames_then_scenes_then_sets(cells):
    overall, *per_set = tables(cells, METHODS)
    assert [table.title for table in per_set] == ["A", "B"]
    for n, method in enumerate(METHODS):
        sets = [[c for c in cells if c.set == name] for name in "AB"]
        for score, enough, pixels in (
            ("psnr_holes", 50, "hole_px"),
            ("psnr_holes_fg", 50, "hole_fg_px"),
            ("psnr_whole", 0, "hole_px"),
        ):
            expected = [twin(own, method, score, enough, pixels) for own in sets]
            got = [table.rows[n].scores.mean(*score.split("_", 1)) for table in per_set]
            assert got == pytest.approx(expected)
            assert overall.rows[n].scores.mean(*score.split("_", 1)) == pytest.approx(statistics.fmean(expected))


def test_the_gain_is_over_scenes_that_both_have(cells):
    _, _, b = tables(cells, METHODS)
    pairs = [
        [twin([c], m, "psnr_holes", 50) for m in METHODS for c in cells if (c.key.scene, c.key.method) == (s, m)]
        for s in ("s2", "s4")
    ]  # s3 of ours failed
    gains = [own - telea for own, telea in pairs]
    assert b.rows[0].over_reference == pytest.approx(statistics.fmean(gains))
    assert b.rows[0].below_reference == sum(gain < 0 for gain in gains)
    assert b.rows[1].over_reference == 0


def test_scenes_below_the_reference_are_counted_and_one_that_it_lacks_is_no_gain(make_cell, make_frame):
    scores = {"a": (20.0, 21.0), "b": (22.0, 20.0), "c": (24.0, 21.0), "d": (30.0, None)}
    made = [
        make_cell(scene, method, "A", [] if psnr is None else [make_frame(psnr_holes=psnr)], None if psnr else "broke")
        for scene, both in scores.items()
        for method, psnr in zip(METHODS, both, strict=True)
    ]
    row = tables(made, METHODS)[0].rows[0]
    assert (row.below_reference, row.over_reference) == (1, pytest.approx(4 / 3))
    own, other = (records(made).where(method=name) for name in METHODS)
    assert gains(own, other) == {"a": -1.0, "b": 2.0, "c": 3.0}


def test_what_is_left_out_is_counted(cells):
    overall, a, b = tables(cells, METHODS)
    assert (a.frames, a.thin_frames, a.empty_frames) == (5, 3, 1)
    assert (b.frames, b.thin_frames, b.empty_frames) == (4, 0, 0)
    assert (overall.frames, overall.thin_frames, overall.empty_frames) == (9, 3, 1)
    assert (a.rows[0].scenes, a.rows[0].scored_scenes, a.rows[0].failed) == (2, 1, 0)
    assert (b.rows[0].scenes, b.rows[0].scored_scenes, b.rows[0].failed) == (3, 2, 1)
    assert (overall.rows[0].scenes, overall.rows[0].failed) == (5, 1)


def test_one_set_needs_no_overall_table_and_one_kind_no_kinds(cells):
    assert [table.title for table in tables(cells[:4], METHODS)] == ["A"]
    assert tables_by_kind(cells, METHODS) == []


def test_nothing_to_average_is_none(make_cell, make_frame):
    scores = records([make_cell("s", "telea", "A", [make_frame(hole_px=0, hole_fg_px=0)])])
    assert scores.mean("psnr", "holes") is None and scores.mean("flicker", "holes") is None
    assert scores.mean("psnr", "whole") == 30
    assert scores.mean("hole_fraction", "hull") == scores.mean("hole_fraction", "image") == 0


def test_every_score_of_a_frame_is_a_record_of_its_own(make_cell, make_frame):
    values = {f.name: float(n) for n, f in enumerate(fields(Scores))}
    found = records([make_cell("s", "telea", "A", [make_frame(**values, past_px=60)])])
    places = {(r.metric, r.region): r.value for r in found if r.metric != "hole_fraction"}
    assert sorted(places.values()) == sorted(values.values())
    assert {metric for metric, _ in places} == {
        "psnr", "psnr_rendered", "ssim", "lpips_alex", "lpips_vgg", "alpha_iou", "flicker", "change", "change_truth",
        "warp_error", "warp_error_truth",
    }  # fmt: skip
    assert places["psnr", "holes_fg"] == values["psnr_holes_fg"] and places["flicker", "holes"] == values["flicker"]
    assert places["change", "still"] == values["change_still"]
    assert places["psnr_rendered", "whole"] == values["psnr_whole_rendered"]
    assert found.where(method="other").all == () and len(found.where(method="telea", region="masked").all) == 4


def test_speed_is_of_frames_with_holes(make_cell, make_frame):
    frames = [make_frame(step_ms=float(ms)) for ms in range(1, 101)]
    taken = speed([make_cell("s", "telea", "A", [*frames, make_frame(hole_px=0, step_ms=1e9)])])
    assert taken is not None
    assert (taken.fps, taken.ms_p50, taken.ms_p95) == (pytest.approx(1000 / 50.5), 50.5, 96)
    assert speed([make_cell("s", "telea", "A", [])]) is None
