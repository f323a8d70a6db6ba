"""Cost of a view: stages, growth exponents, and comparison of reports."""

import json
from dataclasses import asdict, replace

import pytest

from viewmend.cli import main
from viewmend.evaluation import cost
from viewmend.evaluation.cost import STAGES, CostBench, CostReport, compare, fit_growth, read_report
from viewmend.evaluation.provenance import provenance
from viewmend.models.classical import Telea


@pytest.mark.parametrize("power", [0.0, 0.4, 2.0])
def test_the_exponent_of_a_power_law_is_found(power):
    sizes = [1, 2, 5, 9]
    assert fit_growth("viewers", sizes, [3 * size**power for size in sizes]).exponent == pytest.approx(power, abs=2e-3)
    with pytest.raises(ValueError, match="two or more different sizes"):
        fit_growth("viewers", [2, 2], [1.0, 1.0])


@pytest.fixture(scope="module")
def report():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cost, "SCALES", (0.5, 1.0))
        patch.setattr(cost, "VIEWERS", (1, 2))
        bench = CostBench(Telea(), size_px=64, cameras=4, repeats=1)
        machine = provenance("cpu", 1, 1)
        return CostReport(
            model="telea", size_px=64, cameras=4, machine=machine, stages=bench.stages(), growth=bench.growth()
        )


def test_each_stage_and_size_is_measured(report):
    assert tuple(cost.stage for cost in report.stages) == STAGES
    assert all(cost.ms_p95 >= cost.ms > 0 for cost in report.stages if cost.stage != "context")
    assert [grown.by for grown in report.growth] == ["pixels", "cameras", "viewers"], "Telea refines no pixels"


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


@pytest.mark.slow
def test_the_command_measures_writes_and_compares(tmp_path, capsys):
    arguments = ["benchmark", "--model", "telea", "--size", "64", "--cameras", "4", "--repeats", "1"]
    out = tmp_path / "report.json"
    assert main([*arguments, "--out", str(out)]) == 0
    assert "time ~ viewers^" in capsys.readouterr().out
    content = json.loads(out.read_text())
    for stage in content["stages"]:
        stage["ms"] *= 1e-3 if stage["stage"] == "geometry" else 1e3
    out.write_text(json.dumps(content))
    assert main([*arguments, "--versus", str(out)]) == 0
    assert capsys.readouterr().out.strip().endswith("slower: geometry")
