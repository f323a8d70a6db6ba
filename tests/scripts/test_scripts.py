"""The scripts of benchmarks/ and research/ start as they are typed."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = [ROOT / "benchmarks", ROOT / "research"]
FILES = sorted(file for folder in FOLDERS for file in folder.glob("*.py"))
SCRIPTS = [file for file in FILES if '__name__ == "__main__"' in file.read_text(encoding="utf-8")]


def name_of(script: Path) -> str:
    return script.relative_to(ROOT).as_posix()


def start(script: Path, *arguments: str) -> str:
    """The output of a script in a process of its own, without help from this one's environment."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = [sys.executable, str(script), *arguments]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture
def alone(monkeypatch):
    """Modules and search path as when Python starts a script: only what the script imports from its folder is found."""
    local = {file.stem for file in FILES} | {"live", "reference"}
    for name in [name for name in sys.modules if name.split(".")[0] in local]:
        monkeypatch.delitem(sys.modules, name)
    others = [folder for folder in sys.path if Path(folder).resolve() not in (ROOT / "tests", *FOLDERS)]

    def enter(script: Path, *arguments: str) -> None:
        monkeypatch.setattr(sys, "path", [str(script.parent), *others])
        monkeypatch.setattr(sys, "argv", [str(script), *arguments])

    before = set(sys.modules)
    yield enter
    for name in set(sys.modules) - before:
        if name.split(".")[0] in local:
            del sys.modules[name]


@pytest.mark.parametrize("script", SCRIPTS, ids=name_of)
def test_a_script_prints_its_help(script, alone, capsys):
    alone(script, "--help")
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(script), run_name="__main__")
    printed = capsys.readouterr().out
    assert ended.value.code in (0, None) and "usage:" in printed and "--help" in printed


def test_most_files_are_scripts():
    helpers = {name_of(file) for file in FILES} - {name_of(script) for script in SCRIPTS}
    assert helpers == {
        "benchmarks/live_chromium.py",
        "benchmarks/measure.py",
        "benchmarks/tests_path.py",
        "research/benchmarks_path.py",
        "research/corruptions_lib.py",
        "research/less_context.py",
        "research/stream_adapter.py",
    }


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=name_of)
def test_a_script_starts_as_it_is_typed(script):
    assert "usage:" in start(script, "--help")


@pytest.mark.slow
def test_frame_rates_of_all_models_are_measured():
    printed = start(ROOT / "research/baselines.py", "--quick", "--sizes", "160x160")
    for model in ("paper-small", "paper", "views-all", "dstt-o-def"):
        assert f"160x160 {model}: " in printed
