"""Averages over frames, scenes and sets, against plain loops."""

import statistics

import pytest
import torch

from viewmend.evaluation.averages import gains, records, speed, tables

METHODS = ("ours", "telea")


@pytest.fixture
def cells(make_cell, make_frame, rng):
    """Two sets of two and three scenes with random scores, thin and empty frames, and one failed cell."""

    def number(high: float) -> float:
        return high * float(torch.rand((), generator=rng))

    def frame(hole_px: int):
        inside = hole_px // 2
        scores = {
            "psnr_holes": number(30) if hole_px else None,
            "psnr_holes_fg": number(30) if inside else None,
        }
        return make_frame(hole_px=hole_px, hole_fg_px=inside, psnr_whole=number(30), **scores)

    found = []
    scenes = [("A", [60, 40, 200]), ("A", [10, 0]), ("B", [100]), ("B", [300, 99]), ("B", [51])]
    for scene, (name, holes) in enumerate(scenes):
        for method in METHODS:
            failed = (scene, method) == (3, "ours")
            frames = [] if failed else [frame(px) for px in holes]
            found.append(make_cell(f"s{scene}", method, name, frames, "broke" if failed else None))
    return found


def reference_mean(cells, method, score, enough, pixels="hole_px"):
    """Mean over the frames with enough pixels, then over the scenes that have any."""
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
            expected = [reference_mean(own, method, score, enough, pixels) for own in sets]
            assert [table.rows[n].scores.mean(*score.split("_", 1)) for table in per_set] == pytest.approx(
                expected
            )
            assert overall.rows[n].scores.mean(*score.split("_", 1)) == pytest.approx(
                statistics.fmean(expected)
            )


def test_gain_is_over_the_scenes_that_both_methods_have(make_cell, make_frame):
    scores = {"a": (20.0, 21.0), "b": (22.0, 20.0), "c": (24.0, 21.0), "d": (30.0, None)}
    made = [
        make_cell(
            scene,
            method,
            "A",
            [] if psnr is None else [make_frame(psnr_holes=psnr)],
            None if psnr else "broke",
        )
        for scene, both in scores.items()
        for method, psnr in zip(METHODS, both, strict=True)
    ]
    row, reference = tables(made, METHODS)[0].rows
    assert (row.below_reference, row.over_reference, reference.over_reference) == (1, pytest.approx(4 / 3), 0)
    own, other = (records(made).where(method=name) for name in METHODS)
    assert gains(own, other) == {"a": -1.0, "b": 2.0, "c": 3.0}


def test_omitted_frames_and_failures_are_counted(cells):
    overall, a, b = tables(cells, METHODS)
    assert (a.frames, a.thin_frames, a.empty_frames) == (5, 3, 1)
    assert (b.frames, b.thin_frames, b.empty_frames) == (4, 0, 0)
    assert (overall.frames, overall.thin_frames, overall.empty_frames) == (9, 3, 1)
    assert (a.rows[0].scenes, a.rows[0].scored_scenes, a.rows[0].failed) == (2, 1, 0)
    assert (b.rows[0].scenes, b.rows[0].scored_scenes, b.rows[0].failed) == (3, 2, 1)
    assert (overall.rows[0].scenes, overall.rows[0].failed) == (5, 1)


def test_nothing_to_average_is_none(make_cell, make_frame):
    scores = records([make_cell("s", "telea", "A", [make_frame(hole_px=0, hole_fg_px=0)])])
    assert scores.mean("psnr", "holes") is None and scores.mean("flicker", "holes") is None
    assert scores.mean("psnr", "whole") == 30
    assert scores.mean("hole_fraction", "hull") == scores.mean("hole_fraction", "image") == 0


def test_holes_visible_only_in_the_past_have_their_own_mean(make_cell, make_frame):
    frames = [make_frame(psnr_past=20.0, past_px=60), make_frame(psnr_past=10.0, past_px=3)]
    scores = records([make_cell("s", "telea", "P-turn", frames)])
    assert scores.mean("psnr", "past") == 20.0
    assert scores.mean("hole_fraction", "only_past") == pytest.approx((1 + 0.05) / 2)


def test_scenes_that_do_not_tell_what_shows_a_hole_do_not_lower_the_share_of_the_past(make_cell, make_frame):
    cells = [
        make_cell("s", "telea", "P-turn", [make_frame(psnr_past=20.0, past_px=30)]),
        make_cell("t", "telea", "P", [make_frame()]),
    ]
    overall, turning, plain = (table.rows[0].scores for table in tables(cells, ("telea",)))
    assert plain.mean("hole_fraction", "only_past") is None
    assert overall.mean("hole_fraction", "only_past") == turning.mean("hole_fraction", "only_past") == 0.5


def test_holes_are_counted_by_what_shows_them(make_cell, make_frame):
    frame = make_frame(hole_px=100, hole_fg_px=90, sources_px=20, others_px=50, past_px=30, only_past_px=10)
    scores = records([make_cell("s", "telea", "R48", [frame])])
    shares = {kind: scores.mean("share_of_holes", kind) for kind in ("phantom", "sources", "others", "past")}
    assert shares == pytest.approx({"phantom": 0.1, "sources": 0.2, "others": 0.5, "past": 0.1})
    assert scores.mean("share_of_holes", "sources_past") == 0.3


def test_the_standard_error_is_over_scenes(make_cell, make_frame):
    cells = [make_cell(f"s{db}", "telea", "A", [make_frame(psnr_holes=db)]) for db in (10.0, 12.0, 14.0)]
    assert records(cells).standard_error("psnr", "holes") == pytest.approx(2 / 3**0.5)
    assert records(cells[:2]).standard_error("psnr", "holes") is None


def test_the_mean_of_several_sets_has_no_standard_error(make_cell, make_frame):
    cells = [
        make_cell(f"{name}{n}", "telea", name, [make_frame(psnr_holes=db + n)])
        for name, db in {"A": 10.0, "B": 20.0, "C": 30.0}.items()
        for n in range(3)
    ]
    overall, *per_set = (table.rows[0].scores for table in tables(cells, ("telea",)))
    assert [own.standard_error("psnr", "holes") for own in per_set] == pytest.approx([3**-0.5] * 3)
    assert overall.mean("psnr", "holes") == 21 and overall.standard_error("psnr", "holes") is None


def test_speed_covers_frames_with_holes(make_cell, make_frame):
    frames = [make_frame() for _ in range(100)] + [make_frame(hole_px=0)]
    taken = speed([make_cell("s", "telea", "A", frames, step_ms=[*map(float, range(1, 101)), 1e9])])
    assert taken is not None
    assert (taken.fps, taken.ms_p50, taken.ms_p95) == (pytest.approx(1000 / 50.5), 50.5, 96)
    assert speed([make_cell("s", "telea", "A", [])]) is None
