"""What a view costs: counts, floors, exponents, and reports that are compared."""

import json
from dataclasses import asdict, replace

import pytest
import torch

from viewmend.cli import main
from viewmend.evaluation.cost import STAGES, Ceilings, CostBench, CostScene, _counted, ceilings, fitted
from viewmend.evaluation.cost_report import CostReport, read_report, versus, write_plots
from viewmend.evaluation.provenance import provenance
from viewmend.inpainting.checkpoint import load_inpainter

MACHINE = Ceilings(1e9, 1e9)


def test_operations_and_bytes_are_counted():
    a, b = torch.ones(8, 16), torch.ones(16, 4)
    flops, moved = _counted(lambda: (a @ b).T.relu())
    assert flops == 2 * 8 * 16 * 4
    assert moved == 4 * (8 * 16 + 16 * 4 + 8 * 4) + 4 * (2 * 8 * 4), "a view moves nothing"


def test_the_ceilings_are_those_of_a_machine():
    top = ceilings()
    assert 1e8 < top.flops_per_s < 1e15 and 1e7 < top.bytes_per_s < 1e14


@pytest.mark.parametrize("power", [0.0, 0.4, 1.0, 2.0])
def test_exponents_are_those_of_powers(power):
    sizes = [1, 2, 5, 9]
    assert fitted("viewers", sizes, [3 * size**power for size in sizes]).exponent == pytest.approx(power, abs=2e-3)
    with pytest.raises(ValueError, match="two or more different sizes"):
        fitted("viewers", [2, 2], [1.0, 1.0])


@pytest.fixture(scope="module")
def report():
    config = CostScene(size_px=64, cameras=4, repeats=1, scales=(0.5, 1.0), rigs=(3, 4), viewers=(1, 2))
    bench = CostBench(load_inpainter("small"), config)
    return CostReport(
        model="small",
        size_px=64,
        cameras=4,
        machine=provenance("cpu", 1, 1),
        ceilings=MACHINE,
        stages=bench.stages(MACHINE),
        growth=bench.growth(),
    )


def test_each_stage_of_the_streams_record_has_its_cost(report):
    assert tuple(cost.stage for cost in report.stages) == STAGES
    assert all(cost.ms > 0 and cost.bytes > 0 for cost in report.stages)
    costs = {cost.stage: cost for cost in report.stages}
    assert costs["inpainting"].flops > 1e8 and costs["context"].flops > 1e8, "the network is in these two"
    for cost in report.stages:
        assert cost.floor_ms == pytest.approx(1000 * max(cost.flops, cost.bytes) / 1e9, abs=1e-3)
        assert cost.ratio == pytest.approx(cost.ms / cost.floor_ms, abs=0.02)
    assert [grown.by for grown in report.growth] == ["pixels", "cameras", "viewers"], "it chooses no part to mend"


def test_a_stage_that_got_slower_is_named(report, tmp_path):
    report.write(tmp_path / "before.json")
    before = read_report(tmp_path / "before.json")
    assert versus(report, before)[-1] == "no stage is slower"
    stages = [replace(cost, ms=2 * cost.ms if cost.stage == "rendering" else cost.ms) for cost in report.stages]
    assert versus(replace(report, stages=stages), before)[-1] == "slower: rendering"
    with pytest.raises(ValueError, match="measure the same"):
        versus(replace(report, size_px=128), before)


def test_the_file_has_all_of_it_and_plots_are_drawn(report, tmp_path):
    report.write(tmp_path / "report.json")
    content = json.loads((tmp_path / "report.json").read_text())
    assert content == json.loads(json.dumps(asdict(report)))
    assert {"model", "size_px", "cameras", "machine", "ceilings", "stages", "growth"} == content.keys()
    pytest.importorskip("matplotlib")
    write_plots(report, tmp_path / "plots.svg")
    drawn = (tmp_path / "plots.svg").read_text()
    assert all(word in drawn for word in (*STAGES, "pixels", "cameras", "viewers"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--size", "8"], "--size of at least 64"),
        (["--plots", "x.txt"], "--plots as a file"),
        (["--versus", "none.json"], "check --versus"),
        (["--versus", "other.json"], "other.json"),
    ],
)
def test_mistakes_are_one_line(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "other.json").write_text("[]")
    assert main(["benchmark", *arguments]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_measures_writes_and_compares(tmp_path, capsys):
    arguments = ["benchmark", "--model", "telea", "--size", "64", "--cameras", "4", "--repeats", "1"]
    out = tmp_path / "report.json"
    assert main([*arguments, "--out", str(out)]) == 0
    assert "grows with viewers" in capsys.readouterr().out
    content = json.loads(out.read_text())
    for stage in content["stages"]:
        stage["ms"] *= 1e-3 if stage["stage"] == "geometry" else 1e3
    out.write_text(json.dumps(content))
    assert main([*arguments, "--versus", str(out)]) == 0
    assert capsys.readouterr().out.strip().endswith("slower: geometry")
