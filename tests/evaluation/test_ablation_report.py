"""What an ablation's tables say, on cells whose scores are known."""

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest

from viewmend.evaluation.ablation_report import Ablation, Trained, markdown, plots, to_json

HOLES = {  # of each model on the two scenes
    ("full", 0, None): (20.0, 22.0),
    ("full", 1, None): (21.0, 21.0),
    ("full", 0, 64): (19.0, 21.5),
    ("full", 1, 64): (20.0, 20.5),
    ("no-rope", 0, None): (18.0, 23.0),
    ("no-rope", 1, None): (20.0, 20.0),
}


@pytest.fixture
def ablation(make_cell, make_frame):
    trained = [Trained(name, seed, Path(f"m/{name}-{seed}-{k}"), k) for name, seed, k in HOLES]
    methods = {"telea": (15.0, 16.0)} | {str(t.folder): HOLES[t.variant, t.seed, t.top_k] for t in trained}
    ms = {str(t.folder): 10.0 if t.top_k else 30.0 for t in trained}
    cells = [
        make_cell(scene, method, "P", [make_frame(psnr_holes=values[n], step_ms=ms.get(method, 1.0))])
        for n, scene in enumerate(("one", "two"))
        for method, values in methods.items()
    ]
    return Ablation.of(trained, cells)


def test_each_seed_is_compared_with_the_full_model_of_its_seed(ablation):
    full, without = ablation.variants
    assert (full.name, without.name) == ("full", "no-rope")
    assert full.loss == (0.0, 0.0)
    assert without.loss == pytest.approx((0.5, 1.0))
    assert without.loss_by_style == {"calm": pytest.approx(0.75)}
    assert full.holes == pytest.approx((21.0, 21.0))
    assert ablation.telea == pytest.approx(15.5)


def test_top_k_goes_from_few_to_all(ablation):
    few, every = ablation.top_k
    assert (few.name, every.name) == ("64", "all")
    assert few.loss == pytest.approx((0.75, 0.75))
    assert (few.ms, every.ms) == (10.0, 30.0)


def test_it_is_written_in_three_ways(ablation):
    text = markdown(ablation)
    assert "| no-rope | 20.25 (20.50, 20.00) | 0.75 (0.50, 1.00) | 0.75 |" in text
    assert json.loads(to_json(ablation))["variants"][1]["name"] == "no-rope"
    picture = ElementTree.fromstring(plots(ablation))
    words = [element.text for element in picture.iter("{http://www.w3.org/2000/svg}text")]
    assert {"no-rope", "64", "all"} <= set(words)
    groups = {group.get("id"): group for group in picture.iter("{http://www.w3.org/2000/svg}g")}
    dots = [len(list(groups[name].iter("{http://www.w3.org/2000/svg}use"))) for name in ("variant0", "top-k")]
    assert dots == [2, 2], "a dot for each seed that lost, and each top-k"
