"""Names of others never reach a terminal as they are: neither by what is logged nor by a traceback."""

import logging

import pytest

from viewmend.cli import main
from viewmend.utils.logging import escaped_traceback, log_to_terminal

ODD = "\x1b]0;owned\x07cam\nviewmend: wrote all\u202e\x9b2J\x7f"
ESCAPED = "\\x1b]0;owned\\x07cam\\nviewmend: wrote all\\u202e\\x9b2J\\x7f"


@pytest.fixture
def terminal(capsys):
    """Standard error's text so far."""

    def said():
        text = capsys.readouterr().err
        assert all(line.isprintable() for line in text.split("\n"))
        return text

    return said


def unheard(monkeypatch):
    """Have nobody hear the logs; pytest begins to at each test."""
    monkeypatch.setattr(logging.getLogger(), "handlers", [])


def failed():
    try:
        try:
            raise KeyError(ODD)
        except KeyError:
            raise RuntimeError(ODD)  # noqa: B904
    except RuntimeError as error:
        return error


def test_what_is_logged_is_a_line_a_message(terminal, monkeypatch):
    unheard(monkeypatch)
    log_to_terminal()
    log_to_terminal()
    logging.getLogger("viewmend.live").warning("camera '%s' is there", ODD)
    logging.getLogger("viewmend.live").info("nobody asked")
    assert terminal() == f"camera '{ESCAPED}' is there\n"
    logging.getLogger("viewmend.live").error("while rendering %s", ODD, exc_info=failed())
    lines = terminal().splitlines()
    assert lines[:2] == [f"while rendering {ESCAPED}", "Traceback (most recent call last):"]
    assert lines[-1] == f"RuntimeError: {ESCAPED}" and "cam" not in "".join(lines[1:-1]).replace(
        repr(ODD), ""
    )


def test_what_is_said_of_a_capture_is_said_once_a_command(terminal, monkeypatch):
    unheard(monkeypatch)
    for _ in range(2):
        log_to_terminal()
        for camera in ("a", "b", "a", "a"):
            logging.getLogger("viewmend").warning("camera '%s' has no mask", camera)
            logging.getLogger("viewmend.live").warning("camera '%s' is late", camera)
        lines = terminal().splitlines()
        assert lines.count("camera 'a' has no mask") == lines.count("camera 'b' has no mask") == 1
        assert lines.count("camera 'a' is late") == 3


def test_logs_that_somebody_hears_are_left_to_them(monkeypatch):
    unheard(monkeypatch)
    heard = logging.NullHandler()
    logging.getLogger().addHandler(heard)
    log_to_terminal()
    assert logging.getLogger().handlers == [heard]


def test_a_traceback_keeps_an_errors_words_in_its_line():
    lines = escaped_traceback(failed()).split("\n")
    assert lines.count("Traceback (most recent call last):") == 2 and lines[-1] == f"RuntimeError: {ESCAPED}"
    assert "During handling of the above exception, another exception occurred:" in lines
    assert not any(line.startswith("viewmend: wrote") for line in lines) and all(
        line.isprintable() for line in lines
    )


def test_a_command_logs_and_fails_in_escaped_lines(terminal, monkeypatch):
    unheard(monkeypatch)

    def run(_):
        logging.getLogger("viewmend").warning(ODD)
        raise failed()

    monkeypatch.setattr("viewmend.cli.weights.run", run)
    assert main(["weights"]) == 1
    said = terminal()
    assert said.startswith(f"{ESCAPED}\n") and said.endswith(f"RuntimeError: {ESCAPED}\n")
