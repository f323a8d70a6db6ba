"""Input from outside: how much of a file is read, and what is said of what cannot be used."""

from pathlib import Path

MOST_BYTES = 2**23
"""The largest file that is read unless its reader knows better; the calibration of a thousand images has a megabyte."""
MOST_CHARACTERS = 1000
"""A message may be so long: what it quotes from files of others has any length."""
ENDING = 300
"""So much of the end of a longer one stays, where the next step is."""


class InputError(ValueError):
    """Something from outside that cannot be used: what was expected, what came, the next step, in one short line."""

    def __init__(self, message: str) -> None:
        if len(message) > MOST_CHARACTERS:
            message = f"{message[: MOST_CHARACTERS - ENDING - 5]} ... {message[-ENDING:]}"
        super().__init__(message)


def bounded_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """All bytes of a file.

    Raises:
        ValueError: the file is larger than `most`.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(f"expected {path.name} to have at most {most} bytes, got more; is it the right file?")
    return data
