"""The paper's tables: its rows and figures next to ours."""

import csv
import json

import pytest

from viewmend import cli
from viewmend.evaluation.paper_tables import OURS, PaperRow, ablation_models, paper_grid, paper_rows
from viewmend.evaluation.report import make_report
from viewmend.evaluation.scene_run import RunSettings
from viewmend.metrics.weights import FOLDERS_VARIABLE
from viewmend.models.registry import BASELINES

TABLE_3 = ["single-camera-no-masks", "single-camera", "no-past", "no-rope", "full"]


def test_rows_are_the_papers():
    methods = [[row.method for row in paper_rows(table)] for table in (1, 2, 3)]
    assert methods == [["rgvi", *BASELINES, OURS], ["dstt-o-mul", "fuseformer-o-mul", "e2fgvi-o-mul", OURS], TABLE_3]


def test_figures_are_the_papers(shared):
    """Each printed row is in the specification, figure by figure."""
    text = (shared / "design/method.md").read_text()
    flat = " ".join(text.split()).lower()
    for row in paper_rows(1):
        found = [line for line in text.splitlines() if f"{' | '.join(row.figures)} |" in line]
        assert len(found) == 1, row.label
        if row.method in BASELINES:
            assert found[0].split("|")[2].strip() == row.method.split("-")[2], row.label
    for row in paper_rows(2):
        *whole, psnr, ssim, lpips, fps = row.figures
        assert f"{' / '.join(whole)}, holes {psnr} / {ssim}" in flat, row.label
        assert f"{lpips}, {fps}" in flat, row.label
    for row in paper_rows(3):
        label, figures = row.label.replace(",", ""), row.figures
        line = f"{label} {' / '.join(figures[:4])}; {' / '.join(figures[4:7])}; {figures[7]}"
        assert line.lower() in flat, row.label


def test_our_figures_are_means_over_seeds(make_cell, make_frame):
    frames = {"full-s0": 20.0, "full-s1": 22.0, "no-rope": 19.0}
    cells = [make_cell("s", name, "P", [make_frame(psnr_holes=value)]) for name, value in frames.items()]
    cells.append(make_cell("s", "broken", "P", [], "no"))
    report = make_report(cells, (*frames, "broken", "missing"), RunSettings(), {"missing": "no weights"})
    methods = {"full": ("full-s0", "full-s1"), "no-rope": ("no-rope",), "no-past": (), "single-camera": ("broken",)}
    grid = paper_grid([*paper_rows(3), PaperRow("not in the paper", "no-rope")], report, methods)
    lines = [dict(zip(grid.heads, row, strict=True)) for row in grid.rows]
    _, single, no_past, no_rope, full, other = lines
    assert (full["PSNR holes (a) (here)"], full["PSNR HOLES (paper)"]) == ("21.000", "42.184")
    assert (no_rope["PSNR holes (a) (here)"], no_rope["PSNR (paper)"]) == ("19.000", "32.046")
    assert no_past["PSNR (here)"] == "n/a" and no_past["here"] == "none" and no_past["FPS (paper)"] == "41.32"
    assert single["PSNR (here)"] == "n/a" and "**1 failed**" in single["here"]
    assert other["PSNR holes (a) (here)"] == "19.000" and other["PSNR (paper)"] == "-"
    assert all(("(here)" in head) != ("(paper)" in head) for head in grid.heads[2:])


def test_models_of_the_ablation_are_found_by_name(tmp_path):
    for name in ("full-s0", "full-s1", "no-rope", "single-camera", "single-camera-no-masks-s0", "full-old", "other"):
        (tmp_path / name).mkdir()
    found = {name: [path.rpartition("/")[2] for path in paths] for name, paths in ablation_models(tmp_path).items()}
    assert found == {
        "single-camera-no-masks": ["single-camera-no-masks-s0"], "single-camera": ["single-camera"], "no-past": [],
        "no-rope": ["no-rope"], "full": ["full-s0", "full-s1"],
    }  # fmt: skip
    with pytest.raises(ValueError, match="expected folders of models named"):
        ablation_models(tmp_path / "other")


def test_the_command_writes_the_table_in_every_format(tmp_path, monkeypatch, capsys):
    for name in (FOLDERS_VARIABLE, "XDG_CACHE_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "nowhere"))
    command = ["evaluate", "paper-table", "1", "--out", str(tmp_path), "--ours", "nearest", "--no-video"]
    assert cli.main([*command, "--frames", "1", "--scenes", "1", "--size", "128"]) == 0
    text, lines = capsys.readouterr().out, json.loads((tmp_path / "table1.json").read_text())
    assert len(lines) == 24 and lines[19]["here"] == "nearest" and lines[1]["PSNR (here)"] == "n/a"
    assert "Here: 1 scenes, 1 frames of 128 x 128; holes" in text
    assert float(lines[0]["PSNR (here)"]) > 10 and lines[0]["PSNR (paper)"] == "33.478"
    with (tmp_path / "table1.csv").open() as file:
        assert list(csv.DictReader(file)) == lines
    assert text == (tmp_path / "table1.md").read_text()
    assert text.count("dstt-o-def, dstt-o-win, dstt-o-mul: expected") == 1, "one line per reason"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["2"], "expected captures"), (["3"], "expected --models DIR"), (["3", "--models", "x"], "x:")],
)
def test_missing_input_is_explained(tmp_path, capsys, arguments, message):
    assert cli.main(["evaluate", "paper-table", *arguments, "--out", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err
