"""Untrusted input: bounded reading, and JSON as typed values (msgspec) with one-line error messages."""

import hashlib
import json
import re
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

import msgspec
from msgspec import Meta

MOST_BYTES = 2**23
"""Default size limit; the calibration of a thousand images has about a megabyte."""
MOST_CHARACTERS = 1000
"""Maximum length of an error message, which may quote arbitrary input."""
ENDING = 300
"""Characters kept from the end of a longer message, which names the next step."""
Kind = TypeVar("Kind")
"""The type that a message is parsed as."""
FINITE = 1e300
"""Largest magnitude of a number that is accepted."""
Number = Annotated[float, Meta(ge=-FINITE, le=FINITE)]
"""A finite number."""
Triple = tuple[Number, Number, Number]
MOST_PARTS = 2**20
"""Maximum number of lists and objects (counted as brackets); ten thousand cameras need a twentieth of it."""
LARGEST_INTEGER = 2**53
"""Largest integer that JavaScript represents exactly."""
PLAIN_NAMES = {
    "int": "a whole number",
    "float": "a number",
    "str": "a text",
    "bool": "true or false",
    "array": "a list",
    "object": "an object of keys",
}
"""Names of JSON types in messages."""


class InputError(ValueError):
    """Invalid input: what was expected, what was found and the next step, in one short line."""

    def __init__(self, message: str) -> None:
        if len(message) > MOST_CHARACTERS:
            message = f"{message[: MOST_CHARACTERS - ENDING - 5]} ... {message[-ENDING:]}"
        super().__init__(message)


def bounded_bytes(path: Path, most: int = MOST_BYTES) -> bytes:
    """Read a whole file.

    Raises:
        ValueError: the file is larger than `most`.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise ValueError(
            f"expected {path.name} to have at most {most} bytes, got more; is it the right file?"
        )
    return data


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def one_of(*words: str) -> Meta:
    """A string that must be one of these words."""
    return Meta(pattern=f"^({'|'.join(words)})\\Z")


def read_json(text: str | bytes) -> Any:
    """Parse JSON.

    Raises:
        ValueError: the text is not JSON, or has more than `MOST_PARTS` lists and objects, which
            takes too long.
    """
    opening = (b"[", b"{") if isinstance(text, bytes) else ("[", "{")
    parts = sum(map(text.count, opening))
    if parts > MOST_PARTS:
        raise ValueError(
            f"expected JSON of at most {MOST_PARTS} lists and objects, got {parts}; is it the right file?"
        )
    try:
        return json.loads(text, object_hook=_without_nulls, parse_float=_number)
    except (ValueError, RecursionError) as error:  # bad syntax, bad bytes, numbers with thousands of digits
        raise ValueError(f"expected JSON, got something else: {str(error)[:80]}; correct it") from None


def typed(
    value: Any, kind: type[Kind] | Any, next_step: str = "correct the value", strict: bool = True
) -> Kind:
    """Convert a parsed value to `kind`. A null key counts as absent; unknown keys are ignored.

    Args:
        value: a result of `read_json`.
        kind: a msgspec.Struct, or any other type that msgspec takes. Its `__post_init__`
            may raise a ValueError.
        next_step: end of the message, unless the error has its own.
        strict: False accepts strings for numbers, as in a URL query.

    Raises:
        ValueError: the value does not fit, with its path, what was expected and what was found.
    """
    try:
        return msgspec.convert(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        raise ValueError(_explained(str(error), value, kind, next_step)) from None


def shown(value: object, most: int = 200) -> str:
    """A value as JSON, shortened if long."""
    text = json.dumps(value)
    return text if len(text) <= most else text[: most - 3] + "..."


def _without_nulls(value: dict[str, Any]) -> dict[str, Any]:
    """Drop keys that are null."""
    return {key: item for key, item in value.items() if item is not None}


def _number(text: str) -> float | int:
    """Parse a number with a point or exponent; whole numbers become integers."""
    value = float(text)
    return int(value) if abs(value) <= LARGEST_INTEGER and value.is_integer() else value


def _explained(error: str, value: Any, kind: Any, next_step: str) -> str:
    """Rewrite a msgspec error with a readable path and the value that was found."""
    error, _, path = error.partition(" - at `$")
    place, got = _follow(value, path)
    text = error
    missing = re.fullmatch(r"Object missing required field `(.*)`", error)
    if missing:
        place = f"{place}{missing[1]}: "
        text = "expected a value, got nothing"
        next_step = "add the key"
    elif unknown := re.fullmatch(r"Object contains unknown field `(.*)`", error):
        text = f"expected keys among {', '.join(kind.__struct_fields__)}, got '{unknown[1][:40]}'"
    elif wanted := re.fullmatch(r"Expected (.*?)(, got [^,]*)?", error, re.DOTALL):
        text = f"expected {_in_plain_words(wanted[1])}, got {shown(got, 80)}"
    elif error.startswith("Invalid value") and (
        tags := [part.__struct_config__.tag for part in get_args(kind)]
    ):
        text = f"expected {' or '.join(tags)}, got {shown(got, 80)}"
    elif re.match(r"Invalid |Number out of range", error):
        text = f"expected another value, got {shown(got, 80)}"
    return f"{place}{text}" if ";" in text else f"{place}{text}; {next_step}"


def _follow(value: Any, path: str) -> tuple[str, Any]:
    """The readable path ("camera 'b': K[0][2]: ") and the value at it."""
    place = ""
    for key, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        value = value.get(key) if key else value[int(index)]
        place += f": {key}" if key else f"[{index}]"
        if index and isinstance(value, dict) and isinstance(name := value.get("name"), str) and name:
            place = re.sub(r"(\w+?)s?\[\d+\]$", lambda plural, name=name: f"{plural[1]} '{name[:40]}'", place)
    return f"{place.removeprefix(': ')}: " if place else "", value


def _in_plain_words(expected: str) -> str:
    expected = re.sub(r"`float` [<>]= -?1e\+300", "a finite number", expected)
    expected = re.sub(
        r"`str` matching regex '\^\((.*)\)\\\\Z'", lambda words: words[1].replace("|", " or "), expected
    )
    expected = expected.replace("of length >= 1", "that is not empty")
    return re.sub(r"`([^`]*)`", _kinds_in_plain_words, expected)


def _kinds_in_plain_words(kinds: re.Match[str]) -> str:
    return " or ".join(PLAIN_NAMES.get(kind, kind) for kind in kinds[1].split(" | ") if kind != "null")
