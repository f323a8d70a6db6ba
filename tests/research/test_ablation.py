"""The ablation: its variants, its tables, and a short run."""

import json
from dataclasses import asdict, fields
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ablation import TOP_K, VARIANTS, Options, Trained, markdown, plots, run, summarise, variant_recipe
from evaluation.conftest import make_cell, make_frame  # noqa: F401

from viewmend.models.checkpoint import load_config
from viewmend.models.paper.config import paper_small

HOLES = {  # of each model on the two scenes
    ("full", 0, None): (20.0, 22.0),
    ("full", 1, None): (21.0, 21.0),
    ("full", 0, 64): (19.0, 21.5),
    ("full", 1, 64): (20.0, 20.5),
    ("no-rope", 0, None): (18.0, 23.0),
    ("no-rope", 1, None): (20.0, 20.0),
}


@pytest.fixture
def ablation(make_cell, make_frame):  # noqa: F811
    trained = [Trained(name, seed, Path(f"m/{name}-{seed}-{k}"), k) for name, seed, k in HOLES]
    methods = {"telea": (15.0, 16.0)} | {str(t.folder): HOLES[t.variant, t.seed, t.top_k] for t in trained}
    ms = {str(t.folder): 10.0 if t.top_k else 30.0 for t in trained}
    cells = [
        make_cell(scene, method, "P", [make_frame(psnr_holes=values[n])], step_ms=[ms.get(method, 1.0)])
        for n, scene in enumerate(("one", "two"))
        for method, values in methods.items()
    ]
    return summarise(trained, cells)


def test_each_seed_is_compared_with_the_full_model_of_its_seed(ablation):
    full, without = ablation.variants
    assert (full.name, without.name) == ("full", "no-rope")
    assert full.loss == (0.0, 0.0)
    assert without.loss == pytest.approx((0.5, 1.0))
    assert without.loss_by_style == {"calm": pytest.approx(0.75)}
    assert full.holes == pytest.approx((21.0, 21.0))
    assert ablation.telea == pytest.approx(15.5)


def test_top_k_goes_from_few_tokens_to_the_models_own_number(ablation):
    few, own = ablation.top_k
    assert (few.name, own.name) == ("64", "own")
    assert few.loss == pytest.approx((0.75, 0.75))
    assert (few.ms, own.ms) == (10.0, 30.0)


def test_tables_and_plots_show_the_results(ablation):
    text = markdown(ablation)
    assert "| no-rope | 20.25 (20.50, 20.00) | 0.75 (0.50, 1.00) | 0.75 |" in text
    assert json.loads(json.dumps(asdict(ablation)))["variants"][1]["name"] == "no-rope"
    picture = ElementTree.fromstring(plots(ablation))
    words = [element.text for element in picture.iter("{http://www.w3.org/2000/svg}text")]
    assert {"no-rope", "64", "own"} <= set(words)
    groups = {group.get("id"): group for group in picture.iter("{http://www.w3.org/2000/svg}g")}
    dots = [len(list(groups[name].iter("{http://www.w3.org/2000/svg}use"))) for name in ("variant0", "top-k")]
    assert dots == [2, 2], "a dot per seed, and one per top-k"


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_differs_from_the_papers_model_as_stated(name, tmp_path):
    model = variant_recipe(name, Options(out=tmp_path), 0).objective.model
    different = {f.name for f in fields(model) if getattr(model, f.name) != getattr(paper_small(), f.name)}
    assert different == set(VARIANTS[name])


@pytest.mark.slow
def test_an_ablation_trains_evaluates_and_resumes(tmp_path, capsys):
    options = Options(
        out=tmp_path, variants=("no-rope",), seeds=1, samples=4, steps=1, scenes=1, frames=1, size=128, jobs=1
    )
    assert run(options) == 0
    first = capsys.readouterr().out
    assert "| no-rope |" in first and f"| {TOP_K[0]} |" in first and "| own |" in first
    assert {p.name for p in tmp_path.iterdir()} >= {"ablation.md", "ablation.json", "ablation.svg", "models", "samples"}
    assert load_config(tmp_path / "models/no-rope-s0").rope is False
    assert load_config(tmp_path / "models/full-s0-k64").top_k == 64
    (tmp_path / "ablation.md").unlink()
    assert run(options) == 0
    assert capsys.readouterr().out == first
