"""Reports: the same figures in every format, failures included, and a self-contained page."""

import csv
import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from viewmend.data.images import read_rgb
from viewmend.evaluation.report import (
    blocks,
    holes_line,
    main_grid,
    make_report,
    markdown,
    report_csv,
    report_json,
    setting_lines,
    summary,
)
from viewmend.evaluation.report_page import largest_hole, page, write_sheets
from viewmend.evaluation.result_cache import CellStore
from viewmend.evaluation.runner import run_evaluation
from viewmend.evaluation.scene_run import RunSettings
from viewmend.rendering.view import RenderConfig
from viewmend.stream import StreamConfig
from viewmend.utils.contact_sheet import BACKGROUND, GAP_PX, LABEL_PX

METHODS = ("telea", "unfilled", "dstt-o-def")


@pytest.fixture(scope="module")
def evaluated(small_scenes, tmp_path_factory):
    """One scene each of two sets; one cell failed, one method is missing."""
    store = CellStore(tmp_path_factory.mktemp("cells"))
    scenes = [small_scenes[0], small_scenes[2]]
    cells = [cell for found in run_evaluation(scenes, METHODS[:2], store) for cell in found]
    cells[3] = replace(cells[3], error="RuntimeError: a < b", frames=(), step_ms=())
    return make_report(cells, METHODS, RunSettings(), {"dstt-o-def": "no weights & none"}), cells, store


def test_every_format_has_the_same_figures(evaluated):
    report, cells, _ = evaluated
    value = json.loads(report_json(report))
    lines = list(csv.DictReader(io.StringIO(report_csv(report))))
    text = markdown(blocks(report))
    for cell in value["cells"]:
        own = {
            f"{line['metric']}_{line['region']}": float(line["value"])
            for line in lines
            if (line["scene"], line["method"]) == (cell["scene"], cell["method"])
        }
        assert own == {name: number for name, number in cell.items() if name in own}
        assert ("psnr_holes" in own) == (cell["error"] is None) and "lpips_alex_whole" not in own
        if own:
            assert (
                f"{own['psnr_holes']:.2f}" in text and f"{own['ssim_holes']:.5f}" in text and cell["fps"] > 0
            )
    assert all(cell["jobs"] == 1 and cell["threads"] and cell["device"] for cell in value["cells"])
    assert len(value["cells"]) == 4 and {line["method"] for line in lines} == {"telea", "unfilled"}
    assert [value["cells"][0]["psnr_holes"]] == [np.mean([f.psnr_holes for f in cells[0].frames])]
    rows = {row["method"]: row["scores"]["psnr_holes"] for row in value["tables"][1]["rows"][:2]}
    assert rows == {c["method"]: c["psnr_holes"] for c in value["cells"][:2]}, "a set of one scene"
    assert "2 frames of 96 x 96" in text and value["missing"] == {"dstt-o-def": "no weights & none"}


def test_a_model_made_for_another_background_is_named(evaluated):
    _, cells, _ = evaluated
    for background, said in (("black", True), ("white", False)):
        report = make_report(cells, ("telea", "paper-small"), RunSettings(background=background))
        for text in map(markdown, (summary(report), blocks(report))):
            assert ("another background, so they score lower on black: paper-small (white)" in text) == said


def test_every_setting_of_the_cells_is_stated(evaluated):
    _, cells, _ = evaluated
    render = RenderConfig(error_rule="predicted", refine_fraction=0.25)
    stream = StreamConfig(geometry="fused", render=render, memory_mb=None)
    settings = RunSettings(stream=stream, top_k=64, precision="bfloat16")
    report = make_report(
        cells,
        METHODS[:2],
        settings,
        preparation={"align": False, "match_colours": True, "tighten_masks": False},
    )
    (line,) = setting_lines(report)
    for said in (
        "cpu, bfloat16;",
        "geometry fused;",
        "error rule predicted, up to 0.25 of the subject;",
        "64 context tokens;",
        "captures read with --no-align, --no-tighten-masks.",
    ):
        assert said in line
    assert json.loads(report_json(report))["settings"]["preparation"]["align"] is False
    (usual,) = setting_lines(make_report(cells, METHODS[:2], RunSettings()))
    assert "bfloat16 for models trained in it" in usual and "context tokens" not in usual


def test_failures_and_missing_methods_are_in_every_format(evaluated):
    report, _, store = evaluated
    text, shown = markdown(blocks(report)), page(report, store)
    assert "**failed**" in text and "RuntimeError: a < b" in text and "| dstt-o-def | n/a |" in text
    assert "RuntimeError: a &lt; b" in shown and "no weights &amp; none" in shown
    assert "<strong>failed</strong>" in shown and "<td>dstt-o-def</td><td>n/a</td>" in shown
    assert [c["error"] for c in json.loads(report_json(report))["cells"]].count("RuntimeError: a < b") == 1


def test_tables_have_columns_with_values_and_mark_the_best(make_cell, make_frame):
    def cells(method, scores):
        frames = [
            make_frame(psnr_holes=score, psnr_whole=30.0, lpips_alex_whole=1 / score) for score in scores
        ]
        return [make_cell(f"s{n}", method, "A", [frame]) for n, frame in enumerate(frames)]

    found = [
        *cells("telea", (20.0, 22.0, 24.0)),
        *cells("views", (25.0, 25.0, 26.5)),
        *cells("rgvi", (30.0,) * 3),
    ]
    report = make_report(found, ("telea", "views", "rgvi"), RunSettings())
    grid = main_grid(report.tables[0])
    assert {"holes, dB", "whole, dB"} <= set(grid.heads)
    assert not {"failed", "SSIM whole", "flicker", "only past"} & set(grid.heads)
    column = grid.heads.index("holes, dB")
    assert [row[column] for row in grid.rows[:2]] == ["22.00 ± 1.15", "**25.50 ± 0.50**"]
    assert grid.rows[2][column] == "30.00 ± 0.00", "is given the truth"
    assert not any("**" in row[grid.heads.index("whole, dB")] for row in grid.rows), "all are equal"
    assert ["**" in row[grid.heads.index("LPIPS whole")] for row in grid.rows] == [False, True, False]


def test_a_method_that_failed_on_some_scenes_is_never_the_best(make_cell, make_frame):
    scores = {"telea": (20.0, 22.0), "nearest": (19.0, 21.0), "own": (30.0, None)}
    cells = [
        make_cell(f"s{n}", method, "A", [make_frame(psnr_holes=db)] if db else [], None if db else "broke")
        for method, both in scores.items()
        for n, db in enumerate(both)
    ]
    table = make_report(cells, tuple(scores), RunSettings()).tables[0]
    grid = main_grid(table)
    assert [row[grid.heads.index("holes, dB")] for row in grid.rows] == ["**21.00**", "20.00", "30.00"]
    assert "over the other scenes, and never marked: own (1 of 2 scenes)." in holes_line(table)


def test_the_page_is_self_contained_and_has_all_images(evaluated):
    report, cells, store = evaluated
    shown = page(report, store)
    sources = re.findall(r'(?:src|href|poster)="([^"#][^"]{0,30})', shown)
    assert sources and all(re.match(r"data:image/(png|jpeg);base64,", source) for source in sources)
    assert not re.search(r"url\(|@import|<script|<link", shown)
    assert shown.count("<img") == 2, "one of each scene"
    assert page(replace(report, cells=tuple(cells * 2)), store, shown=1).count("<img") == 2, "one of each set"


def test_every_scene_has_a_contact_sheet(evaluated, tmp_path):
    _, cells, store = evaluated
    assert sorted(path.name for path in write_sheets(cells, store, tmp_path)) == ["s1.png", "s3.png"]
    # E, rendered, two methods and the truth: whole, close up, and what is wrong, of which E and the truth have nothing.
    sheet = read_rgb(tmp_path / "s1.png", "s1")
    height = (sheet.shape[0] - GAP_PX) // 5
    width = (sheet.shape[1] - GAP_PX) // 3
    tiles = sheet[GAP_PX:, GAP_PX:].reshape(5, height, 3, width, 3).swapaxes(1, 2)[:, :, LABEL_PX:]
    shown = [[bool((c[: -2 * GAP_PX, : -2 * GAP_PX] != BACKGROUND).any()) for c in row] for row in tiles]
    assert shown == [[True, True, False], *[[True] * 3] * 3, [True, True, False]]


def test_sheets_of_scenes_whose_names_make_one_file_name_are_all_kept(
    make_cell, make_frame, tmp_path, monkeypatch
):
    sheets = {name: np.full((4, 4, 3), n, np.uint8) for n, name in enumerate(("人-左", "人-右", "s3"))}
    monkeypatch.setattr(
        "viewmend.evaluation.report_page.scene_sheet", lambda own, _: sheets[own[0].key.scene]
    )
    cells = [make_cell(name, "telea", "A", [make_frame()]) for name in sheets]
    written = write_sheets(cells, CellStore(tmp_path / "cells"), tmp_path)
    assert [int(read_rgb(path, str(path)).mean()) for path in written] == [0, 1, 2]
    assert written[2] == tmp_path / "s3.png"


def test_the_page_shows_three_scores_and_explains_every_column(evaluated):
    report, _, store = evaluated
    shown = page(report, store)
    head = shown.split("<thead>")[1].split("</thead>")[0]
    heads = re.findall(r"<th([^>]*)>([^<]*)</th>", head)
    first = [text for attributes, text in heads if "later" not in attributes]
    assert first == ["method", "whole, dB", "holes, dB", "in mask"], "LPIPS was not measured"
    unexplained = [text for attributes, text in heads[1:] if "title=" not in attributes]
    assert not unexplained
    assert shown.count("<details>") == len(report.tables)


def test_the_close_up_contains_the_largest_hole():
    error = np.zeros((60, 90, 3), np.uint8)
    error[5:8, 5:8], error[40:58, 80:90] = 255, 255
    top, left, side = largest_hole(error)
    assert top <= 40 and top + side >= 58 and left <= 80 and left + side >= 90 and side < 40
    assert largest_hole(np.zeros((60, 90, 3), np.uint8))[2] <= 60


def test_a_run_without_holes_says_what_to_change(make_cell, make_frame):
    for px, advised in ((20, True), (60, False)):
        frame = make_frame(psnr_holes=20.0, hole_px=px)
        table = make_report([make_cell("s", "telea", "A", [frame])], ("telea",), RunSettings()).tables[0]
        assert ("--every" in holes_line(table)) == advised
