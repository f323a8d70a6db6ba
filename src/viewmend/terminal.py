"""What a terminal may be shown: names come from files, folders and networks of others."""

import logging
import sys
import traceback


def printable(text: str) -> str:
    """The text with all that is no visible character or space escaped.

    No name moves a cursor, hides a line, turns one around or begins one.
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def printable_traceback(error: BaseException) -> str:
    """A traceback whose lines are the programs' own: what its errors say stays in theirs."""
    parts = traceback.TracebackException.from_exception(error)
    lines = [line for part in parts.format() for line in _escaped(part)]
    return "\n".join(lines)


def log_to_terminal() -> None:
    """Have this process write what is logged, warnings and worse, to standard error, each message on one line.

    Does nothing where somebody else hears the logs already.
    """
    if not logging.getLogger().handlers:
        logging.getLogger().addHandler(_Lines(logging.WARNING))


class _Lines(logging.Handler):
    """Writes records to standard error, as it is then."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = printable(record.getMessage())
            if record.exc_info and record.exc_info[1] is not None:
                text += "\n" + printable_traceback(record.exc_info[1])
            print(text, file=sys.stderr, flush=True)
        except Exception:  # as all handlers do: a log that fails ends nothing
            self.handleError(record)


def _escaped(part: str) -> list[str]:
    """Lines of a part of a traceback; an error's message is one, however many it has."""
    ours = ("File ", "Traceback ", "The above exception ", "During handling ")
    whole = part.strip("\n")
    return [printable(line) for line in (whole.split("\n") if whole.lstrip(" |+-").startswith(ours) else [whole])]
