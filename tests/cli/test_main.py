import json
import os
import signal
import subprocess
import sys
from time import sleep
from types import SimpleNamespace

import pytest

from viewmend import cli
from viewmend.cli import console, main
from viewmend.cli.checks import check_device
from viewmend.cli.console import busy, printable, say, show, track


def run_command(monkeypatch, run, arguments=()):
    """Put `run` in the place of a command."""
    from viewmend.cli import check

    monkeypatch.setattr(check, "run", run)
    return cli.main(["check", "x", *arguments])


@pytest.mark.parametrize("arguments", [["--help"], ["check", "--help"], ["check"], ["nonsense"]])
def test_help_and_mistakes_import_nothing_heavy(arguments):
    check = (
        "import sys; from viewmend.cli import main; code = main(sys.argv[1:]);"
        "heavy = {'torch', 'cv2', 'numba', 'skimage', 'av'} & set(sys.modules); print(code, heavy, file=sys.stderr)"
    )
    done = subprocess.run(
        [sys.executable, "-c", check, *arguments], capture_output=True, text=True, check=True
    )
    assert done.stderr.splitlines()[-1] == f"{0 if '--help' in arguments else 2} set()"


def test_a_folder_of_the_user_may_follow_an_equals_sign(monkeypatch):
    monkeypatch.setenv("HOME", "/somewhere")
    seen = []
    assert run_command(monkeypatch, seen.append, ["--out=~/a~/b.png"]) == 0
    assert str(seen[0].out) == "/somewhere/a~/b.png"


def raising(error):
    def run(options):
        raise error

    return run


@pytest.mark.parametrize(
    "error", [ValueError("too\nbad"), FileNotFoundError(2, "no such", "f"), OSError("full")]
)
def test_what_a_user_can_get_wrong_is_one_line(monkeypatch, capsys, error):
    assert run_command(monkeypatch, raising(error)) == 2
    out, message = capsys.readouterr()
    assert out == "" and message.startswith(f"viewmend: error: {' '.join(str(error).split())}")
    assert message.count("\n") == 1 and ("check the path" in message) == (
        getattr(error, "filename", None) == "f"
    )


def test_our_own_mistakes_interruption_and_success(monkeypatch, capsys):
    assert run_command(monkeypatch, raising(KeyError("ours"))) == 1
    message = capsys.readouterr().err
    assert "Traceback" in message and "KeyError: 'ours'" in message
    assert run_command(monkeypatch, raising(KeyboardInterrupt())) == 130
    assert "Traceback" not in capsys.readouterr().err
    assert run_command(monkeypatch, lambda options: 0) == 0
    assert run_command(monkeypatch, lambda options: SimpleNamespace(), ["--no-such-option"]) == 2


def test_unknown_commands_are_answered_with_the_known_ones(capsys):
    assert cli.main(["mned"]) == 2
    assert f"among {', '.join(cli.COMMANDS)}" in capsys.readouterr().err


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("viewmend 0.")


def test_json_has_no_nan(capsys):
    console.print_json({"a": float("nan"), "b": [1.5, float("inf")], "c": {"d": (None, "x")}})
    assert json.loads(capsys.readouterr().out) == {"a": None, "b": [1.5, None], "c": {"d": [None, "x"]}}


def test_long_work_is_announced_with_its_duration(monkeypatch, capsys):
    now_s = iter([10.0, 40.0, 70.0, 100.0, 130.0])
    monkeypatch.setattr(console.time, "monotonic", lambda: next(now_s))
    assert list(console.announce_duration("abcde", "views", "--scale 0.5 is faster")) == list("abcde")
    assert capsys.readouterr().err == "5 views will take about 2 min; --scale 0.5 is faster\n"
    assert list(console.announce_duration([], "views")) == []


@pytest.mark.parametrize("terminal", [False, True])
def test_tracking_passes_everything_on(monkeypatch, capsys, terminal):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    assert list(console.track(iter([3, 1, 2]), "counting", total=3)) == [3, 1, 2]
    out, message = capsys.readouterr()
    assert out == ""
    assert ("counting" in message) == terminal


# What people are told: progress without a terminal, names that others chose, signals.


def test_names_of_others_move_no_cursor(capsys):
    name = "a\x1b[2Jb\rc\u202ed\x00e\ud800f\ng"
    say(name)
    show(name, "über 日本")
    said = capsys.readouterr()
    assert said.err == "a\\x1b[2Jb\\rc\\u202ed\\x00e\\ud800f\\ng\n"
    assert said.out == f"{said.err}über 日本\n", "no name begins a line"
    assert printable("plain text") == "plain text"


def test_an_error_is_one_line_whatever_it_names(capsys):
    assert main(["check", "no\x1b]0;such\x07\u202efolder"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said[:-1].isprintable() and "\\x1b]0;such\\x07\\u202efolder" in said


def test_progress_is_said_without_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr(console, "INTERVAL_S", 0.05)
    for _ in track(range(2), "counting"):
        sleep(0.4)
    with busy("thinking"):
        sleep(0.4)
    said = capsys.readouterr().err.splitlines()
    assert {"counting: 0 of 2", "counting: 1 of 2, 0 s left", "thinking: 0 s so far"} <= set(said)
    assert [console._duration(s) for s in (80.0, 1200.0, 9000.0)] == ["80 s", "20 min", "2.5 h"]
    sleep(0.12)
    assert capsys.readouterr().err == "", "an end is an end"


@pytest.mark.parametrize("arguments", [["mend", "x", "--out", ""], ["mend", "x", "--out="], ["check", " "]])
def test_an_empty_value_is_refused(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert "got an empty one; is a variable unset?" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_request_ends_a_step_and_only_a_later_ctrl_c_everything(number, monkeypatch, capsys):
    before = signal.getsignal(number)
    monkeypatch.setattr(console, "REPEATED_S", 1e9)
    with console.stop_requests() as stopped:
        assert not stopped()
        os.kill(os.getpid(), number)
        assert stopped() == number and "saving a checkpoint" in capsys.readouterr().err
        for again in (
            signal.SIGINT,
            signal.SIGTERM,
            signal.SIGINT,
        ):  # torchrun and `timeout` signal several times
            os.kill(os.getpid(), again)
        monkeypatch.setattr(console, "REPEATED_S", -1.0)
        os.kill(os.getpid(), signal.SIGTERM)
        assert stopped() == number and capsys.readouterr().err == ""
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            sleep(1)
    assert signal.getsignal(number) == before


def test_a_reader_that_has_seen_enough_is_no_error():
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-u", "-m", "viewmend", "--help"]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, check=False)
    os.close(writing)
    assert done.returncode and done.stderr == b""


def test_sigterm_lets_a_command_clean_up(tmp_path):
    # A signal that arrives just before a sleep does not interrupt it, so sleeps are short.
    program = (
        "import pathlib, sys, time\n"
        "from viewmend.cli import console\n"
        "with console.exit_on_sigterm():\n"
        "    try:\n        print('begun', flush=True)\n"
        "        for _ in range(400):\n            time.sleep(0.05)\n"
        "    finally:\n        pathlib.Path(sys.argv[1]).write_text('cleaned')\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path / "a")], stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == b"begun\n"
        process.terminate()
        assert process.wait(20) == 143
    assert (tmp_path / "a").read_text() == "cleaned"


@pytest.mark.parametrize("encoding", ["cp1252", "ascii", "cp932:strict"])
def test_letters_that_the_output_cannot_show_are_escaped(encoding):
    program = (
        "import sys; from viewmend.cli import check, main; from viewmend.cli.console import say, show\n"
        "check.run = lambda options: show(str(options.capture)) or say(str(options.capture)) or 0\n"
        "sys.exit(main(['check', 'カメラ Łódź ü']))"
    )
    environment = os.environ | {"PYTHONIOENCODING": encoding}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, env=environment, check=False)
    assert done.returncode == 0 and done.stderr.strip() == done.stdout.strip()
    shown = done.stdout.decode(encoding.partition(":")[0]).strip()
    assert (
        shown.encode("ascii", "backslashreplace").decode()
        == "カメラ Łódź ü".encode("ascii", "backslashreplace").decode()
    )


@pytest.mark.parametrize("locale", ["C", "POSIX"])
def test_names_are_utf8_in_every_locale(tmp_path, locale):
    (tmp_path / "カメラ1").mkdir()
    program = (
        "import os, sys; from viewmend.cli import check, main; from viewmend.cli.console import show\n"
        "check.run = lambda options: show(ascii([str(options.format), *os.listdir(options.capture)]), chr(252)) or 0\n"
        "sys.exit(main())"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("LC_", "LANG"))}
    environment |= {"LC_ALL": locale, "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-c", program, "check", tmp_path, "--format", "カメラ1"]
    done = subprocess.run(command, capture_output=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    names, letter = done.stdout.decode("ascii").splitlines()
    assert names == ascii(["カメラ1", "カメラ1"]) and letter == "\\xfc"


def test_a_gpu_that_does_not_exist_is_refused(monkeypatch):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    for name in ("cpu", "cuda", "cuda:1"):
        check_device(name)
    with pytest.raises(ValueError, match=r"available device \(cpu, cuda, cuda:0, cuda:1\), got 'cuda:2'"):
        check_device("cuda:2")
