"""`viewmend export` says in one line what it cannot write."""

import importlib.util

import pytest

from viewmend.cli import main


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["paper-small", "--format", "onnx", "--out", "{}/m.onnx"],
            "got 'paper-small', a PatchTransformer; export 'views'",
        ),
        (["views", "--format", "pt2", "--out", "{}/m.onnx"], "expected --out to end in .pt2, got"),
        (["views", "--format", "onnx", "--out", "{}/none/m.onnx"], "expected a folder to write to, found none"),
        (["nobody", "--format", "onnx", "--out", "{}/m.onnx"], "one of the shipped models"),
    ],
)
def test_what_cannot_be_exported_is_said(tmp_path, capsys, arguments, said):
    assert main(["export", *(word.format(tmp_path) for word in arguments)]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_missing_compiler_is_said(tmp_path, capsys, monkeypatch):
    from torch._inductor import config

    monkeypatch.setattr(config.cpp, "cxx", (None, "no-such-compiler"))
    assert main(["export", "views", "--format", "pt2", "--out", str(tmp_path / "m.pt2")]) == 2
    assert "expected a C++ compiler for --format pt2, found none" in capsys.readouterr().err


def test_a_missing_extra_is_said(tmp_path, capsys, monkeypatch):
    there = importlib.util.find_spec
    monkeypatch.setattr("viewmend.export.model.find_spec", lambda name: None if name == "onnxscript" else there(name))
    assert main(["export", "views", "--format", "onnx", "--out", str(tmp_path / "m.onnx")]) == 2
    assert "expected onnxscript for --format onnx, got none; pip install 'viewmend[all]'" in capsys.readouterr().err
