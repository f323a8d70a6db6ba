"""The paper's tables: its rows and figures, ours beside them, never mixed."""

import csv
import json

import pytest

from viewmend import cli
from viewmend.evaluation.paper_tables import (
    OURS,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    PaperFigures,
    PaperRow,
    ablation_models,
    paper_grid,
)
from viewmend.evaluation.report import make_report
from viewmend.evaluation.scene_run import RunSettings
from viewmend.methods import BASELINES
from viewmend.metrics.weights import PLACES_VARIABLE


def test_rows_are_the_papers():
    assert len(TABLE_1) == 20 and [row.method for row in TABLE_1] == ["rgvi", *BASELINES, OURS]
    assert [row.method for row in TABLE_2] == ["dstt-o-mul", "fuseformer-o-mul", "e2fgvi-o-mul", OURS]
    assert [row.method for row in TABLE_3][-1] == "full" and len(TABLE_3) == 5


def test_figures_are_the_papers(shared):
    """Each printed row is in the specification, figure for figure."""
    text = (shared / "design/method.md").read_text()
    for row in TABLE_1:
        f = row.figures
        line = (
            f"{f.psnr:.3f} | {f.ssim:.4f} | {f.lpips:.4f} | {f.vfid:.4f} | {f.psnr_holes:.3f} | {f.ssim_holes:.5f} | "
            f"{f.lpips_holes:.5f} | {f.fps:.2f} |"
        )
        found = [told for told in text.splitlines() if line in told]
        assert len(found) == 1, row.label
        if row.method in BASELINES:
            assert found[0].split("|")[2].strip() == row.method.split("-")[2], row.label
    flat = " ".join(text.split())
    for row in TABLE_2:
        f = row.figures
        told = (
            f"{f.psnr:.3f} / {f.ssim:.4f} / {f.lpips:.4f} / {f.vfid:.4f}, holes {f.psnr_holes:.3f} / {f.ssim_holes:.4f}"
        )
        assert told in flat, row.label
        assert f"{f.lpips_holes:.4f}, {f.fps:.2f}" in flat, row.label
    for row in TABLE_3:
        f, label = row.figures, row.label.replace(",", "")
        whole = f"{f.psnr:.3f} / {f.ssim:.4f} / {f.lpips:.4f} / {f.vfid:.4f}"
        holes = f"{f.psnr_holes:.3f} / {f.ssim_holes:.4f} / {f.lpips_holes:.4f}"
        assert f"{label} {whole}; {holes}; {f.fps:.2f}".lower() in flat.lower(), row.label


@pytest.fixture
def report(make_cell, make_frame):
    frames = {"full-s0": 20.0, "full-s1": 22.0, "no-rope": 19.0}
    cells = [make_cell("s", name, "P", [make_frame(psnr_holes=value)]) for name, value in frames.items()]
    cells.append(make_cell("s", "broken", "P", [], "no"))
    return make_report(cells, (*frames, "broken", "missing"), RunSettings(), {"missing": "no weights"})


def test_ours_stand_beside_the_papers_as_means_of_seeds(report):
    methods = {"full": ("full-s0", "full-s1"), "no-rope": ("no-rope",), "no-past": (), "single-camera": ("broken",)}
    grid = paper_grid(TABLE_3, report, methods)
    lines = [dict(zip(grid.heads, row, strict=True)) for row in grid.rows]
    full, no_rope, no_past, single = lines[4], lines[3], lines[2], lines[1]
    assert (full["PSNR holes (a) (here)"], full["PSNR HOLES (paper)"]) == ("21.000", "42.184")
    assert (no_rope["PSNR holes (a) (here)"], no_rope["PSNR (paper)"]) == ("19.000", "32.046")
    assert no_past["PSNR (here)"] == "n/a" and no_past["here"] == "none" and no_past["FPS (paper)"] == "41.32"
    assert single["PSNR (here)"] == "n/a" and "**1 failed**" in single["here"]
    assert all(("(here)" in head) != ("(paper)" in head) for head in grid.heads[2:])


def test_models_of_the_ablation_are_found_by_name(tmp_path):
    for name in ("full-s0", "full-s1", "no-rope", "single-camera", "single-camera-no-masks-s0", "full-old", "other"):
        (tmp_path / name).mkdir()
    found = {name: [path.rpartition("/")[2] for path in paths] for name, paths in ablation_models(tmp_path).items()}
    assert found == {
        "single-camera-no-masks": ["single-camera-no-masks-s0"], "single-camera": ["single-camera"], "no-past": [],
        "no-rope": ["no-rope"], "full": ["full-s0", "full-s1"],
    }  # fmt: skip
    with pytest.raises(ValueError, match="viewmend ablation trains them"):
        ablation_models(tmp_path / "other")


def test_the_command_writes_the_table_in_every_form(tmp_path, monkeypatch, capsys):
    for name in (PLACES_VARIABLE, "XDG_CACHE_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "nowhere"))
    command = ["evaluate", "paper-table", "1", "--out", str(tmp_path), "--ours", "nearest", "--no-video"]
    assert cli.main([*command, "--frames", "1", "--scenes", "1", "--size", "128"]) == 0
    text, lines = capsys.readouterr().out, json.loads((tmp_path / "table1.json").read_text())
    assert len(lines) == 24 and lines[19]["here"] == "nearest" and lines[1]["PSNR (here)"] == "n/a"
    assert "Here: 1 scenes, 1 frames of 128 x 128; holes" in text
    assert float(lines[0]["PSNR (here)"]) > 10 and lines[0]["PSNR (paper)"] == "33.478"
    with (tmp_path / "table1.csv").open() as file:
        assert list(csv.DictReader(file)) == lines
    assert (
        text == (tmp_path / "table1.md").read_text() and text.count("dstt-o-def, dstt-o-win, dstt-o-mul: expected") == 1
    )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["2"], "expected captures"), (["3"], "expected --models DIR"), (["3", "--models", "x"], "x:")],
)
def test_what_is_missing_is_said(tmp_path, capsys, arguments, said):
    assert cli.main(["evaluate", "paper-table", *arguments, "--out", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


def test_nothing_printed_is_nothing_shown(report):
    row = PaperRow("full", "full", PaperFigures(psnr=32.616, fps=41.55))
    assert paper_grid([row], report, {"full": ("full-s0",)}).rows[0][-1] == "41.55"
    assert paper_grid([row], report, {"full": ("full-s0",)}).rows[0][-2] == "-"
