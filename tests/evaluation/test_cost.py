"""Cost of a view: stages, and comparison of reports."""

import json
from dataclasses import asdict, replace

import pytest

from viewmend.cli import main
from viewmend.evaluation.cost import STAGES, CostReport, compare, measure_stages, read_report
from viewmend.evaluation.provenance import provenance
from viewmend.models.classical import Telea


@pytest.fixture(scope="module")
def report():
    stages = measure_stages(Telea(), size_px=64, cameras=4, repeats=1)
    return CostReport(model="telea", size_px=64, cameras=4, machine=provenance("cpu", 1, 1), stages=stages)


def test_each_stage_is_measured(report):
    assert tuple(cost.stage for cost in report.stages) == STAGES
    assert all(cost.ms_p95 >= cost.ms > 0 for cost in report.stages if cost.stage != "context")


def test_slower_stages_are_named(report, tmp_path):
    report.write(tmp_path / "before.json")
    assert json.loads((tmp_path / "before.json").read_text()) == json.loads(json.dumps(asdict(report)))
    before = read_report(tmp_path / "before.json")
    assert compare(report, before)[-1] == "no stage is slower"
    stages = [replace(cost, ms=2 * cost.ms if cost.stage == "rendering" else cost.ms) for cost in report.stages]
    assert compare(replace(report, stages=stages), before)[-1] == "slower: rendering"
    with pytest.raises(ValueError, match="measure the same"):
        compare(replace(report, size_px=128), before)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--size", "8"], "--size of at least 64"),
        (["--versus", "none.json"], "check --versus"),
        (["--versus", "other.json"], "other.json"),
    ],
)
def test_invalid_options_are_explained(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other.json").write_text("[]")
    assert main(["benchmark", *arguments]) == 2
    assert message in capsys.readouterr().err


def test_the_command_measures_writes_and_compares(tmp_path, capsys):
    arguments = ["benchmark", "--model", "telea", "--size", "64", "--cameras", "4", "--repeats", "1"]
    out = tmp_path / "report.json"
    assert main([*arguments, "--out", str(out)]) == 0
    assert "inpainting" in capsys.readouterr().out
    content = json.loads(out.read_text())
    for stage in content["stages"]:
        stage["ms"] *= 1e-3 if stage["stage"] == "geometry" else 1e3
    out.write_text(json.dumps(content))
    assert main([*arguments, "--versus", str(out)]) == 0
    assert capsys.readouterr().out.strip().endswith("slower: geometry")
