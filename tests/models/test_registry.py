"""Methods by name: groups, baselines without weights, classes in files."""

import json

import pytest

from viewmend import cli
from viewmend.metrics.weights import FOLDERS_VARIABLE
from viewmend.models import registry as methods
from viewmend.models.checkpoint import shipped_models
from viewmend.models.registry import (
    BASELINES,
    METHODS,
    MethodMissing,
    identity,
    make_method,
    method_names,
    split_missing,
)

OWN = """
from dataclasses import dataclass
from viewmend.models.classical import Telea
@dataclass
class Mine(Telea):
    device: str
number = 3
"""


@pytest.fixture(autouse=True)
def nowhere(tmp_path, monkeypatch):
    """No published weights, whatever this machine has."""
    for name in (FOLDERS_VARIABLE, "XDG_CACHE_HOME", "TORCH_HOME"):
        monkeypatch.setenv(name, str(tmp_path / "nowhere"))


def test_groups_stand_for_their_methods_each_once():
    assert set(method_names("all")) == {*shipped_models(), *METHODS}
    assert method_names("telea, all , telea")[0] == "telea" and len(set(method_names("telea,all"))) == len(
        METHODS
    ) + len(shipped_models())
    assert method_names("baselines") == BASELINES and len(BASELINES) == 18
    with pytest.raises(ValueError, match="or names with commas"):
        method_names(" , ")


def test_methods_without_weights_are_set_apart_with_the_reason():
    with pytest.raises(MethodMissing, match="the generator of DSTT"):
        make_method("dstt-o-def")
    available, missing = split_missing(("dstt-o-def", "telea"))
    assert available == ("telea",) and set(missing) == {"dstt-o-def"}
    with pytest.raises(ValueError, match="expected a method among"):
        split_missing(("telea", "no-such-method"))


def test_a_damaged_checkpoint_is_an_error_not_a_gap(tmp_path, monkeypatch):
    (tmp_path / "dstt.pth").write_bytes(b"PK")
    monkeypatch.setenv(FOLDERS_VARIABLE, str(tmp_path))
    with pytest.raises(ValueError, match="got 2 bytes that do not read"):
        split_missing(("dstt-o-def",))


def test_reports_have_the_row_and_say_why_it_is_empty(tmp_path, capsys):
    arguments = ["evaluate", "P", "--scenes", "1", "--frames", "1", "--size", "96", "--out", str(tmp_path / "out")]
    assert cli.main([*arguments, "--methods", "unfilled,dstt-o-mul"]) == 0
    assert "| dstt-o-mul | n/a | n/a |" in capsys.readouterr().out
    text = (tmp_path / "out" / "report.md").read_text()
    assert "* dstt-o-mul: expected the generator of DSTT as dstt.pth" in text
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert list(report["missing"]) == ["dstt-o-mul"] and report["methods"] == ["unfilled", "dstt-o-mul"]
    assert {cell["method"] for cell in report["cells"]} == {"unfilled"}
    assert cli.main([*arguments, "--weights", str(tmp_path / "absent")]) == 2
    assert "expected a folder of weights, found none" in capsys.readouterr().err


def test_a_class_in_a_file_is_a_method_and_a_changed_file_another(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(OWN)
    made = make_method(f"{path}:Mine", "cpu")
    assert made.device == "cpu" and identity(made) == identity(make_method(f"{path}:Mine"))
    path.write_text(OWN + "\n# better\n")
    assert identity(make_method(f"{path}:Mine")) != identity(made)


def test_a_class_that_does_not_take_the_device_is_refused(tmp_path):
    (tmp_path / "own.py").write_text("class Bare:\n    pass\n")
    with pytest.raises(ValueError, match=r"own\.py:Bare: expected a callable that takes the device"):
        make_method(f"{tmp_path / 'own.py'}:Bare")


@pytest.mark.parametrize("name", ["{}:Other", "{}:number", "absent.py:Mine"])
def test_names_that_a_file_does_not_have_are_refused(name, tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    with pytest.raises(ValueError, match=r"check (FILE.py:NAME|the path)"):
        make_method(name.format(tmp_path / "own.py"))


@pytest.mark.parametrize(
    ("shipped", "default"), [(("rays", "views"), "views"), (("paper-small",), "paper-small"), ((), "telea")]
)
def test_the_default_mends_whole_views(monkeypatch, shipped, default):
    monkeypatch.setattr(methods, "shipped_models", lambda: shipped)
    assert methods.default_method() == default
