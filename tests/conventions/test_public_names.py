"""`viewmend.__all__` is the same for users, type checkers, the reference and an installed package."""

import ast
import subprocess
import sys
import tomllib
from importlib import import_module
from pathlib import Path

import pytest

import viewmend

ROOT = Path(__file__).resolve().parents[2]
TREE = ast.parse((ROOT / "src/viewmend/__init__.py").read_text())
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_dir_lists_the_public_names():
    assert sorted(dir(viewmend)) == sorted(viewmend.__all__)
    for name in viewmend.__all__:
        assert getattr(viewmend, name) is not None


def test_type_checkers_find_the_names():
    [block] = [n for n in TREE.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING"]
    shown = {a.name: n.module for n in block.body if isinstance(n, ast.ImportFrom) for a in n.names}
    assert sorted({*shown, "__version__"}) == sorted(viewmend.__all__)
    for name, module in shown.items():
        value = getattr(viewmend, name)
        assert value is getattr(import_module(module), name)
        assert getattr(value, "__module__", module) == module, "import it from where it is defined"


def test_the_reference_documents_each():
    page = (ROOT / "docs/api.md").read_text().split()
    shown = {
        name: f"{getattr(viewmend, name).__module__}.{name}"
        for name in viewmend.__all__
        if name != "__version__"
    }
    assert [place for place in shown.values() if place not in page] == []


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Steam'"):
        viewmend.Steam  # noqa: B018


def test_importing_the_package_loads_no_library():
    check = "import sys, viewmend; dir(viewmend); print([m for m in ('torch', 'numpy', 'cv2') if m in sys.modules])"
    assert (
        subprocess.run([sys.executable, "-c", check], capture_output=True, text=True, check=True).stdout
        == "[]\n"
    )


def test_the_installed_package_is_typed_and_has_a_version():
    assert "py.typed" in PROJECT["tool"]["setuptools"]["package-data"]["viewmend"]
    assert (ROOT / "src/viewmend/py.typed").is_file()
    assert PROJECT["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "viewmend.__version__"}


def test_names_can_be_imported_without_the_extras():
    missing = "for name in ('tensorboard', 'OpenEXR', 'onnx', 'onnxscript', 'ray'): sys.modules[name] = None"
    code = chr(10).join(["import sys", missing, "from viewmend import *", "Client, Stream"])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
