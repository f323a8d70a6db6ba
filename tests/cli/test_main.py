import json
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from viewmend import cli
from viewmend.cli import console


def run_command(monkeypatch, run, arguments=()):
    """Put `run` in the place of a command."""
    from viewmend.cli import check

    monkeypatch.setattr(check, "run", run)
    return cli.main(["check", "x", *arguments])


def test_help_comes_at_once():
    begun = time.monotonic()
    done = subprocess.run([sys.executable, "-m", "viewmend", "--help"], capture_output=True, text=True, check=False)
    # Half a second on a quiet machine; what must never happen is the import of torch, which is tested below.
    assert time.monotonic() - begun < 3
    assert done.returncode == 0 and all(c.name in done.stdout for c in cli.COMMANDS)


@pytest.mark.parametrize("arguments", [["--help"], ["check", "--help"], ["check"], ["nonsense"]])
def test_help_and_mistakes_import_nothing_heavy(arguments):
    check = (
        "import sys; from viewmend.cli import main; code = main(sys.argv[1:]);"
        "heavy = {'torch', 'cv2', 'numba', 'skimage', 'av'} & set(sys.modules); print(code, heavy, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", check, *arguments], capture_output=True, text=True, check=True)
    expected = 0 if "--help" in arguments else 2
    assert done.stderr.splitlines()[-1] == f"{expected} set()"


@pytest.mark.parametrize(
    ("error", "code"), [(ValueError("too\nbad"), 2), (FileNotFoundError(2, "no such", "f"), 2), (OSError("full"), 2)]
)
def test_what_a_user_can_get_wrong_is_one_line(monkeypatch, capsys, error, code):
    def run(options):
        raise error

    assert run_command(monkeypatch, run) == code
    out, message = capsys.readouterr()
    assert out == "" and message.startswith(f"viewmend: error: {' '.join(str(error).split())}")
    assert message.count("\n") == 1 and ("check the path" in message) == (getattr(error, "filename", None) == "f")


def test_our_own_mistakes_show_where(monkeypatch, capsys):
    def run(options):
        raise KeyError("ours")

    assert run_command(monkeypatch, run) == 1
    message = capsys.readouterr().err
    assert "Traceback" in message and "KeyError: 'ours'" in message


def test_interruption_and_success(monkeypatch, capsys):
    def interrupted(options):
        raise KeyboardInterrupt

    assert run_command(monkeypatch, interrupted) == 130
    assert "Traceback" not in capsys.readouterr().err
    assert run_command(monkeypatch, lambda options: 0) == 0
    assert run_command(monkeypatch, lambda options: SimpleNamespace(), ["--no-such-option"]) == 2


def test_unknown_commands_are_answered_with_the_known_ones(capsys):
    assert cli.main(["mned"]) == 2
    assert f"among {', '.join(c.name for c in cli.COMMANDS)}" in capsys.readouterr().err


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("viewmend 0.")


def test_json_has_no_nan(capsys):
    console.print_json({"a": float("nan"), "b": [1.5, float("inf")], "c": {"d": (None, "x")}})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [1.5, None], "c": {"d": [None, "x"]}}


@pytest.mark.parametrize("terminal", [False, True])
def test_tracking_passes_everything_on(monkeypatch, capsys, terminal):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    assert list(console.track(iter([3, 1, 2]), "counting", total=3)) == [3, 1, 2]
    out, message = capsys.readouterr()
    assert out == ""
    assert ("counting" in message) == terminal


@pytest.mark.parametrize("terminal", [False, True])
def test_busy_is_shown_on_a_terminal(monkeypatch, capsys, terminal):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    with console.busy("thinking"):
        pass
    out, message = capsys.readouterr()
    assert out == "" and ("thinking" in message) == terminal
