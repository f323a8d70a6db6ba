"""Reports: the same figures in every form, nothing hidden, a page that needs nothing but itself."""

import csv
import io
import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from viewmend.evaluation import report_video
from viewmend.evaluation.cells import CellStore
from viewmend.evaluation.report import make_report
from viewmend.evaluation.report_data import report_csv, report_json
from viewmend.evaluation.report_markdown import markdown
from viewmend.evaluation.report_page import page
from viewmend.evaluation.report_plot import Point, ablation_plot, trade_off
from viewmend.evaluation.report_sheets import largest_hole, write_sheets
from viewmend.evaluation.report_video import scene_video
from viewmend.evaluation.runner import run_evaluation
from viewmend.evaluation.scene_run import RunSettings

METHODS = ("telea", "unfilled", "dstt-o-def")


@pytest.fixture(scope="module")
def evaluated(small_scenes, tmp_path_factory):
    """One scene each of two sets; one cell failed, one method is missing."""
    store = CellStore(tmp_path_factory.mktemp("cells"))
    scenes = [small_scenes[0], small_scenes[2]]
    cells = [cell for found in run_evaluation(scenes, METHODS[:2], store) for cell in found]
    cells[3] = replace(cells[3], error="RuntimeError: a < b", frames=())
    return make_report(cells, METHODS, RunSettings(), {"dstt-o-def": "no weights & none"}), cells, store


def test_every_form_has_the_same_figures(evaluated):
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


def test_failures_and_gaps_are_shown_in_every_form(evaluated):
    report, cells, store = evaluated
    text, shown = markdown(report), page(report, cells, store)
    assert "**failed**" in text and "RuntimeError: a < b" in text and "| dstt-o-def | n/a |" in text
    assert "RuntimeError: a &lt; b" in shown and "no weights &amp; none" in shown
    assert "unfilled: failed" in shown and "<td>dstt-o-def</td><td>n/a</td>" in shown
    assert [c["error"] for c in json.loads(report_json(report))["cells"]].count("RuntimeError: a < b") == 1


def test_the_page_asks_nobody_for_anything_and_has_all_pictures(evaluated):
    report, cells, store = evaluated
    shown = page(report, cells, store)
    sources = re.findall(r'(?:src|href|poster)="([^"#][^"]{0,30})', shown)
    assert sources and all(re.match(r"data:(image/(png|jpeg)|video/mp4);base64,", source) for source in sources)
    assert not re.search(r"url\(|@import|<script|<link", shown)
    # Scene by scene: rendered, E, truth and each method that did not fail; E and the truth have no difference.
    assert shown.count("whole view") - 1 == 2 * (3 + 2 + 3 + 1) + 0 * len(sources)
    assert shown.count(", difference from the truth") == 2 * (1 + 2 + 1 + 1)
    assert shown.count("<video") == 2 and page(report, cells, store, video=False).count("<video") == 0
    assert page(report, cells * 2, store, shown=1).count("<section>") == 2  # one of each set
    assert shown.count("<svg") == 3 and "quality against milliseconds" in shown


def test_a_video_shows_the_streams_side_by_side(evaluated, monkeypatch, tmp_path):
    cv2 = pytest.importorskip("cv2")
    _, cells, store = evaluated
    own = [cell for cell in cells if cell.key.scene == "s1"]
    kind, data = scene_video(own, store)

    def refuse(*_):
        raise ImportError

    monkeypatch.setattr(report_video, "write_mp4", refuse)
    other_kind, other = scene_video(own, store)
    assert (kind, other_kind) == ("video/mp4", "video/webm")
    for name, bytes_ in (("v.mp4", data), ("v.webm", other)):
        (tmp_path / name).write_bytes(bytes_)
        reader = cv2.VideoCapture(str(tmp_path / name))
        frames = [frame for ok, frame in iter(reader.read, (False, None)) if ok]
        assert len(frames) == 2 and frames[0].shape[1] > 4 * 250 and frames[0].std() > 10
    films = store.film(own[0]), *store.scene_film(own[0])
    assert [len(film) for film in films] == [2, 2, 2] and len({film[0].shape for film in films}) == 1
    assert scene_video([replace(cell, error="x") for cell in own], store) is None


def test_sheets_are_written_for_every_scene(evaluated, tmp_path):
    _, cells, store = evaluated
    assert sorted(path.name for path in write_sheets(cells, store, tmp_path)) == ["s1.png", "s3.png"]


def test_the_largest_hole_is_in_the_close_up():
    error = np.zeros((60, 90, 3), np.uint8)
    error[5:8, 5:8], error[40:58, 80:90] = 255, 255
    top, left, side = largest_hole(error)
    assert top <= 40 and top + side >= 58 and left <= 80 and left + side >= 90 and side < 40
    assert largest_hole(np.zeros((60, 90, 3), np.uint8))[2] <= 60


def test_the_plot_has_every_method_and_no_label_on_another():
    points = [Point(f"method {n} & co", 10.0 ** (n % 3), 20 + 0.01 * n) for n in range(9)]
    svg = trade_off([*points, Point("free", 0.0, 21.0)], "dB", "title")
    assert svg == trade_off([*points, Point("free", 0.0, 21.0)], "dB", "title")
    assert svg.count('class="dot"') == 10 and "<title>method 3 &amp; co: 20.03, 1.0 ms</title>" in svg
    found = re.findall(r'<text [^>]*x="([\d.]+)" y="([\d.-]+)"[^>]*>(?:method|free)', svg)
    labels = [(float(x), float(y)) for x, y in found]
    assert len(labels) == 10 and all(0 < y < 400 for _, y in labels)
    close = [
        (a, b) for n, a in enumerate(labels) for b in labels[:n] if abs(a[0] - b[0]) < 60 and abs(a[1] - b[1]) < 11
    ]
    assert not close
    assert trade_off([], "dB", "title") == ""
    assert trade_off([Point("one", 5.0, 20.0)], "dB", "t").count('class="dot"') == 1


def test_without_matplotlib_the_page_says_what_is_missing(evaluated, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    shown = page(*evaluated, video=False)
    assert "<svg" not in shown and shown.count("pip install &#x27;viewmend[plots]&#x27;") == 3
    with pytest.raises(ValueError, match=r"pip install 'viewmend\[plots\]'"):
        ablation_plot([], [], "losses")
