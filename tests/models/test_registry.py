"""Methods by name: groups, baselines without weights, classes in files."""

import numpy as np
import pytest

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
class Bare:
    pass
class Plain(Telea):
    pass
class Faded(Telea):
    def __init__(self, fading=0.9):
        self.fading = fading
class Named(Telea):
    def __init__(self, where):
        self.where = where
class Demanding(Telea):
    def __init__(self, device, fading):
        self.fading = fading
number = 3
"""


pytestmark = pytest.mark.usefixtures("no_weights")


def test_groups_stand_for_their_methods_each_once():
    assert set(method_names("all")) == {*shipped_models(), *METHODS}
    assert method_names("telea, all , telea")[0] == "telea"
    assert len(method_names("telea,all")) == len(METHODS) + len(shipped_models())
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


def test_a_class_in_a_file_is_a_method_and_a_changed_file_another(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(OWN)
    made = make_method(f"{path}:Mine", "cpu")
    assert made.device == "cpu" and identity(made) == identity(make_method(f"{path}:Mine"))
    path.write_text(OWN + "\n# better\n")
    assert identity(make_method(f"{path}:Mine")) != identity(made)


@pytest.mark.parametrize(
    "kept", ["np.load(file)", "file.read_bytes()", "set(file.read_bytes())", "Holder(np.load(file))"]
)
def test_weights_in_any_container_make_another_method(kept, tmp_path):
    """Stored results of the old weights must not be taken for those of the new ones."""
    path = tmp_path / "own.py"
    file = tmp_path / "weights.npy"
    start = (
        "import logging\nimport numpy as np\nfrom pathlib import Path\nfrom viewmend.models.classical import Telea\n"
        "class Holder:\n    def __init__(self, values):\n        self.values = values\n"
        f"file = Path({str(file)!r})\n"
    )
    log = "        self.log = logging.getLogger('own')\n"
    path.write_text(f"{start}class Own(Telea):\n    def __init__(self):\n        self.kept = {kept}\n{log}")
    found = []
    for weight in (1.0, 1.0, 2.0):
        np.save(file, np.full(3, weight, np.float32))
        found.append(identity(make_method(f"{path}:Own")))
    assert found[0] == found[1] != found[2]


def test_a_class_need_not_take_the_device(tmp_path):
    path = tmp_path / "own.py"
    path.write_text(OWN)
    assert type(make_method(f"{path}:Plain")).__name__ == "Plain"
    assert make_method(f"{path}:Faded").fading == 0.9, "a parameter with a default is not the device"
    assert make_method(f"{path}:Named", "cpu").where == "cpu"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        *(("{}:Other", "check FILE.py:NAME"), ("{}:number", "check FILE.py:NAME")),
        ("absent.py:Mine", "check the path"),
        ("{}:Bare", r"own\.py:Bare: expected an inpainter, got Bare; make its class a subclass"),
        (
            "{}:Demanding",
            r"Demanding: expected .* no argument but the device, got .*fading\); give the others",
        ),
    ],
)
def test_names_that_a_file_does_not_have_and_other_classes_are_refused(name, message, tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    with pytest.raises(ValueError, match=message):
        make_method(name.format(tmp_path / "own.py"))


@pytest.mark.parametrize(
    ("shipped", "default"), [(("rays", "views"), "views"), (("paper-small",), "paper-small"), ((), "telea")]
)
def test_the_default_mends_whole_views(monkeypatch, shipped, default):
    monkeypatch.setattr(methods, "shipped_models", lambda: shipped)
    assert methods.default_method() == default
