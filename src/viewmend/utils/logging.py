"""Terminal output that is safe to print: names come from untrusted files and networks."""

import logging
import sys
import traceback


def printable(text: str) -> str:
    """Escape everything that is not a printable character, so that no name can move the cursor or hide a line."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def escaped_traceback(error: BaseException) -> str:
    """Format a traceback with each error message escaped onto a single line."""
    ours = ("File ", "Traceback ", "The above exception ", "During handling ")
    lines = []
    for part in traceback.TracebackException.from_exception(error).format():
        whole = part.strip("\n")
        lines += whole.split("\n") if whole.lstrip(" |+-").startswith(ours) else [whole]
    return "\n".join(map(printable, lines))


def log_to_terminal() -> None:
    """Log warnings and errors of this process to standard error, one line per message.

    Messages about captures appear once, however often a command opens them. Does nothing if the
    root logger already has another handler.
    """
    handlers = logging.getLogger().handlers
    for handler in handlers:
        if isinstance(handler, _Lines):
            handler.facts.clear()
    if not handlers:
        logging.getLogger().addHandler(_Lines())


class _Lines(logging.Handler):
    """Writes records to the current standard error."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.facts: set[str] = set()
        """Warnings of the logger `viewmend`, which are about files and do not change while a command runs."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            text = printable(record.getMessage())
            if record.name == "viewmend":
                if text in self.facts:
                    return
                self.facts.add(text)
            if record.exc_info and record.exc_info[1] is not None:
                text += "\n" + escaped_traceback(record.exc_info[1])
            print(text, file=sys.stderr, flush=True)
        except Exception:  # logging must never raise
            self.handleError(record)
