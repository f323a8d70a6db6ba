"""Reports: the same figures in every format, failures included, and a self-contained page."""

import csv
import io
import json
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from viewmend.evaluation.report import main_grid, make_report, markdown, report_csv, report_json, summary
from viewmend.evaluation.report_page import Point, largest_hole, page, scene_video, trade_off, write_sheets
from viewmend.evaluation.result_cache import CellStore
from viewmend.evaluation.runner import run_evaluation
from viewmend.evaluation.scene_run import RunSettings
from viewmend.evaluation.video_strip import STRIP_PX, Box, make_strip, split_strip, subject_box

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
    text = markdown(report)
    for cell in value["cells"]:
        own = {
            f"{line['metric']}_{line['region']}": float(line["value"])
            for line in lines
            if (line["scene"], line["method"]) == (cell["scene"], cell["method"])
        }
        assert own == {name: number for name, number in cell.items() if name in own}
        assert ("psnr_holes" in own) == (cell["error"] is None) and "lpips_alex_whole" not in own
        if own:
            assert f"{own['psnr_holes']:.2f}" in text and f"{own['ssim_holes']:.5f}" in text and cell["fps"] > 0
    assert len(value["cells"]) == 4 and {line["method"] for line in lines} == {"telea", "unfilled"}
    assert [value["cells"][0]["psnr_holes"]] == [np.mean([f.psnr_holes for f in cells[0].frames])]
    rows = {row["method"]: row["scores"]["psnr_holes"] for row in value["tables"][1]["rows"][:2]}
    assert rows == {c["method"]: c["psnr_holes"] for c in value["cells"][:2]}, "a set of one scene"
    assert "2 frames of 96 x 96" in text and value["missing"] == {"dstt-o-def": "no weights & none"}


def test_a_model_made_for_another_background_is_named(evaluated):
    _, cells, _ = evaluated
    for background, said in (("black", True), ("white", False)):
        report = make_report(cells, ("telea", "paper-small"), RunSettings(background=background))
        for text in (summary(report), markdown(report)):
            assert ("another background than black, on which they score lower: paper-small (white)" in text) == said


def test_failures_and_missing_methods_are_in_every_format(evaluated):
    report, _, store = evaluated
    text, shown = markdown(report), page(report, store, video=False)
    assert "**failed**" in text and "RuntimeError: a < b" in text and "| dstt-o-def | n/a |" in text
    assert "RuntimeError: a &lt; b" in shown and "no weights &amp; none" in shown
    assert "unfilled: failed" in shown and "<td>dstt-o-def</td><td>n/a</td>" in shown
    assert [c["error"] for c in json.loads(report_json(report))["cells"]].count("RuntimeError: a < b") == 1


def test_tables_have_columns_with_values_and_mark_the_best(make_cell, make_frame):
    def cells(method, scores):
        frames = [make_frame(psnr_holes=score, psnr_whole=30.0) for score in scores]
        return [make_cell(f"s{n}", method, "A", [frame]) for n, frame in enumerate(frames)]

    found = [*cells("telea", (20.0, 22.0, 24.0)), *cells("views", (25.0, 25.0, 26.5)), *cells("rgvi", (30.0,) * 3)]
    report = make_report(found, ("telea", "views", "rgvi"), RunSettings())
    grid = main_grid(report.tables[0])
    assert {"holes, dB", "whole, dB"} <= set(grid.heads)
    assert not {"failed", "SSIM whole", "flicker", "only past"} & set(grid.heads)
    column = grid.heads.index("holes, dB")
    assert [row[column] for row in grid.rows[:2]] == ["22.00 ± 2.0", "**25.50 ± 0.9**"]
    assert grid.rows[2][column] == "30.00 ± 0.0", "is given the truth"
    assert not any("**" in row[grid.heads.index("whole, dB")] for row in grid.rows), "all are equal"


def test_the_page_is_self_contained_and_has_all_images(evaluated):
    report, cells, store = evaluated
    shown = page(report, store)
    sources = re.findall(r'(?:src|href|poster)="([^"#][^"]{0,30})', shown)
    assert sources and all(re.match(r"data:(image/(png|jpeg)|video/mp4);base64,", source) for source in sources)
    assert not re.search(r"url\(|@import|<script|<link", shown)
    # Per scene: rendered, E, truth and each method that did not fail; E and the truth have no difference.
    assert shown.count(", whole view") == 2 * (3 + 2 + 3 + 1), "in alt and title"
    assert shown.count(", difference from the truth") == 2 * (1 + 2 + 1 + 1)
    assert shown.count("<video") == 2 and page(report, store, video=False).count("<video") == 0
    twice = replace(report, cells=tuple(cells * 2))
    assert page(twice, store, shown=1, video=False).count("<section>") == 2, "one of each set"
    assert shown.count("<svg") == 3 and "quality against milliseconds" in shown


def test_a_video_shows_the_streams_side_by_side(evaluated, tmp_path):
    _, cells, store = evaluated
    own = [cell for cell in cells if cell.key.scene == "s1"]
    (tmp_path / "v.mp4").write_bytes(scene_video(own, store))
    reader = cv2.VideoCapture(str(tmp_path / "v.mp4"))
    frames = [frame for ok, frame in iter(reader.read, (False, None)) if ok]
    assert len(frames) == 2 and frames[0].shape[1] > 4 * 250 and frames[0].std() > 10
    strips = store.strip(own[0]), *store.scene_strip(own[0])
    assert [len(strip) for strip in strips] == [2, 2, 2] and len({strip[0].shape for strip in strips}) == 1
    assert scene_video([replace(cell, error="x") for cell in own], store) is None


def test_every_scene_has_a_contact_sheet(evaluated, tmp_path):
    _, cells, store = evaluated
    assert sorted(path.name for path in write_sheets(cells, store, tmp_path)) == ["s1.png", "s3.png"]


def test_the_close_up_contains_the_largest_hole():
    error = np.zeros((60, 90, 3), np.uint8)
    error[5:8, 5:8], error[40:58, 80:90] = 255, 255
    top, left, side = largest_hole(error)
    assert top <= 40 and top + side >= 58 and left <= 80 and left + side >= 90 and side < 40
    assert largest_hole(np.zeros((60, 90, 3), np.uint8))[2] <= 60


def test_the_plot_has_every_method_and_no_overlapping_labels():
    points = [Point(f"method {n} & co", 10.0 ** (n % 3), 20 + 0.01 * n) for n in range(9)]
    svg = trade_off([*points, Point("free", 0.0, 21.0)], "dB", "title")
    assert svg.count('class="dot"') == 10 and "<title>method 3 &amp; co: 20.03, 1.0 ms</title>" in svg
    found = re.findall(r'<text [^>]*x="([\d.]+)" y="([\d.-]+)"[^>]*>(?:method|free)', svg)
    labels = [(float(x), float(y)) for x, y in found]
    assert len(labels) == 10 and all(0 < y < 400 for _, y in labels)
    assert not [
        (a, b) for n, a in enumerate(labels) for b in labels[:n] if abs(a[0] - b[0]) < 60 and abs(a[1] - b[1]) < 11
    ]
    assert trade_off([], "dB", "title") == ""
    assert trade_off([Point("one", 5.0, 20.0)], "dB", "t").count('class="dot"') == 1


def test_the_box_has_a_margin_around_the_subject():
    subject = torch.zeros(200, 300, dtype=torch.bool)
    assert subject_box(subject) is None
    subject[50, 60] = subject[149, 99] = True
    assert subject_box(subject) == Box(44, 54, 156, 106), "6 % of a hundred rows"
    subject[0, 299] = True
    assert subject_box(subject) == Box(0, 46, 164, 300), "clipped by the image"
    assert Box(1, 5, 20, 30).union(Box(2, 3, 25, 28)) == Box(1, 3, 25, 30)


def test_strips_are_cropped_and_scaled_down():
    frames = [np.zeros((600, 400, 3), np.uint8) for _ in range(3)]
    for n, frame in enumerate(frames):
        frame[100:612, 200:328] = 50 + 50 * n
    strip = make_strip(frames, Box(100, 200, 600, 328))
    assert strip is not None and strip.shape == (3 * STRIP_PX, round(128 * STRIP_PX / 500), 3)
    assert [float(part.mean()) for part in split_strip(strip, 3)] == [50, 100, 150]
    assert make_strip(frames, None).shape == (3 * STRIP_PX, round(400 * STRIP_PX / 600), 3)
    assert make_strip(frames, Box(0, 0, 40, 30)).shape == (120, 30, 3), "never enlarged"
    assert make_strip([], None) is None and split_strip(strip, 5) == []
