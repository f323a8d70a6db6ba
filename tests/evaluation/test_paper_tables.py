"""The paper's tables: its rows and figures next to ours."""

import csv
import json
from dataclasses import replace

import pytest

from viewmend import cli
from viewmend.cli import evaluate_paper_table
from viewmend.evaluation.paper_tables import (
    OURS,
    PaperRow,
    Training,
    ablation_models,
    paper_grid,
    paper_rows,
    row_label,
    training_of,
)
from viewmend.evaluation.report import make_report
from viewmend.evaluation.scene_run import RunSettings
from viewmend.metrics.weights import FOLDERS_VARIABLE
from viewmend.models.checkpoint import build, save_inpainter
from viewmend.models.paper.config import paper_small
from viewmend.models.registry import BASELINES

TABLE_3 = ["single-camera-no-masks", "single-camera", "no-past", "no-rope", "full"]


def test_rows_are_the_papers():
    methods = [[row.method for row in paper_rows(table)] for table in (1, 2, 3)]
    assert methods == [
        ["rgvi", *BASELINES, OURS],
        ["dstt-o-mul", "fuseformer-o-mul", "e2fgvi-o-mul", OURS],
        TABLE_3,
    ]


def test_our_figures_are_means_over_seeds(make_cell, make_frame):
    frames = {"full-s0": 20.0, "full-s1": 22.0, "no-rope": 19.0}
    cells = [make_cell("s", name, "P", [make_frame(psnr_holes=value)]) for name, value in frames.items()]
    cells.append(make_cell("s", "broken", "P", [], "no"))
    report = make_report(cells, (*frames, "broken", "missing"), RunSettings(), {"missing": "no weights"})
    methods = {
        "full": ("full-s0", "full-s1"),
        "no-rope": ("no-rope",),
        "no-past": (),
        "single-camera": ("broken",),
    }
    grid = paper_grid([*paper_rows(3), PaperRow("not in the paper", "no-rope")], report, methods)
    lines = [dict(zip(grid.heads, row, strict=True)) for row in grid.rows]
    _, single, no_past, no_rope, full, other = lines
    assert (full["PSNR holes (a) (here)"], full["PSNR inpainted, reading (b) (paper)"]) == (
        "21.000",
        "42.184",
    )
    assert (no_rope["PSNR holes (a) (here)"], no_rope["PSNR (paper)"]) == ("19.000", "32.046")
    assert no_past["PSNR (here)"] == "n/a" and no_past["here"] == "none" and no_past["FPS (paper)"] == "41.32"
    assert single["PSNR (here)"] == "n/a" and "**1 failed**" in single["here"]
    assert other["PSNR holes (a) (here)"] == "19.000" and other["PSNR (paper)"] == "-"
    assert all(("(here)" in head) != ("(paper)" in head) for head in grid.heads[2:])


def test_models_of_the_ablation_are_found_by_name(tmp_path):
    for name in (
        "full-s0",
        "full-s1",
        "no-rope",
        "single-camera",
        "single-camera-no-masks-s0",
        "full-old",
        "other",
    ):
        (tmp_path / name).mkdir()
    found = {
        name: [path.rpartition("/")[2] for path in paths] for name, paths in ablation_models(tmp_path).items()
    }
    assert found == {
        "single-camera-no-masks": ["single-camera-no-masks-s0"], "single-camera": ["single-camera"], "no-past": [],
        "no-rope": ["no-rope"], "full": ["full-s0", "full-s1"],
    }  # fmt: skip
    with pytest.raises(ValueError, match="expected folders of models named"):
        ablation_models(tmp_path / "other")


@pytest.mark.usefixtures("no_weights")
def test_the_command_writes_the_table_in_every_format(tmp_path, capsys):
    command = ["evaluate", "paper-table", "1", "--out", str(tmp_path), "--ours", "nearest"]
    assert cli.main([*command, "--frames", "1", "--scenes", "1", "--size", "128"]) == 0
    text, lines = capsys.readouterr().out, json.loads((tmp_path / "table1.json").read_text())
    assert len(lines) == 25 and lines[19]["here"] == "none" and lines[1]["PSNR (here)"] == "n/a"
    assert (lines[20]["row"], lines[20]["here"]) == ("not in the paper", "nearest")
    assert "Here: 1 scenes, 1 frames of 128 x 128; holes" in text
    assert lines[0]["PSNR (here)"] == "n/a" and lines[0]["PSNR (paper)"] == "33.478", (
        "RGVI needs its networks"
    )
    assert float(lines[20]["PSNR (here)"]) > 10 and 0 < float(lines[20]["LPIPS (here)"]) < 1
    with (tmp_path / "table1.csv").open() as file:
        assert list(csv.DictReader(file)) == lines
    assert text == (tmp_path / "table1.md").read_text()
    assert text.count("dstt-o-def, dstt-o-win, dstt-o-mul: expected") == 1, "one line per reason"


def test_only_a_model_of_the_papers_recipe_has_the_papers_row(tmp_path):
    card = "# m\n\nTrained by `viewmend train {}` from {}: 9 steps of 4 samples\nx 1 streams in 81 minutes, seed 0.\n"
    net = build(replace(paper_small(), widths=(8,) * 9, dim=32, heads=2, blocks=1))
    expected = {
        ("paper-small", "random weights"): "the paper's model",
        ("paper", "`masked`"): "the paper's model, pre-trained (masked)",
        ("finetune", "random weights"): "the paper's architecture, trained otherwise",
    }
    for number, ((recipe, start), label) in enumerate(expected.items()):
        save_inpainter(net, tmp_path / str(number), card.format(recipe, start))
        assert row_label(str(tmp_path / str(number))) == label
    assert training_of(tmp_path / "0") == Training("paper-small", None, 81)
    labels = {name: row_label(name) for name in ("paper-small", "views", "rays", "telea")}
    assert labels == {
        "paper-small": "the paper's model, pre-trained (a patch autoencoder)", "views": "ours, not the paper's",
        "rays": "ours, not the paper's", "telea": "not in the paper",
    }  # fmt: skip


def test_a_network_trained_from_scratch_is_not_called_fine_tuned(tmp_path, monkeypatch):
    folder = tmp_path / "finetuned" / "dstt"
    folder.mkdir(parents=True)
    (folder / "model.safetensors").touch()
    monkeypatch.setenv(FOLDERS_VARIABLE, str(tmp_path))
    row = PaperRow("DSTT finetuned, def", "dstt-o-def-finetuned")
    for start, label in (
        ("random weights", "DSTT, trained from scratch (81 minutes), def"),
        ("`dstt.pth`", "DSTT finetuned, def"),
    ):
        (folder / "README.md").write_text(
            f"Trained by `viewmend train dstt` from {start}: 9 steps in 81 minutes."
        )
        assert evaluate_paper_table._relabelled(row, None).label == label
