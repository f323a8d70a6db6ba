"""JSON from outside as typed values (msgspec); what does not fit is refused with one clear line."""

import json
import re
from typing import Annotated, Any, TypeVar, get_args

import msgspec
from msgspec import Meta

Kind = TypeVar("Kind")

FINITE = 1e300
Number = Annotated[float, Meta(ge=-FINITE, le=FINITE)]
"""A finite number."""
Triple = tuple[Number, Number, Number]
MOST_PARTS = 2**20
"""The most lists and objects of a text, brackets within its words among them; ten thousand cameras have a twentieth."""
LARGEST_INTEGER = 2**53
"""The largest whole number up to which JavaScript counts exactly."""
PLAIN_NAMES = {
    "int": "a whole number",
    "float": "a number",
    "str": "a text",
    "bool": "true or false",
    "array": "a list",
    "object": "an object of keys",
}
"""What JSON's types are called in messages."""


def one_of(*words: str) -> Meta:
    """A text that is one of these words."""
    return Meta(pattern=f"^({'|'.join(words)})\\Z")


def read_json(text: str | bytes) -> Any:
    """Parse JSON.

    Raises:
        ValueError: the text is not JSON; says where. Or it holds more lists and objects than anything that is read here
            has: millions of them take many seconds, and a hundred times their own size.
    """
    opening = (b"[", b"{") if isinstance(text, bytes) else ("[", "{")
    if (parts := sum(map(text.count, opening))) > MOST_PARTS:  # pyright: ignore[reportArgumentType]
        raise ValueError(f"expected JSON of at most {MOST_PARTS} lists and objects, got {parts}; is it the right file?")
    try:
        return json.loads(text, object_hook=_without_nulls, parse_float=_number)
    except (ValueError, RecursionError) as error:  # of syntax, of bytes, of numbers with thousands of digits
        raise ValueError(f"expected JSON, got something else: {str(error)[:80]}; correct it there") from None


def typed(value: Any, kind: type[Kind] | Any, next_step: str = "correct the value", strict: bool = True) -> Kind:
    """A parsed value as `kind`. A key that is null counts as absent; keys that `kind` does not have are ignored.

    Args:
        value: what `read_json` gives.
        kind: a msgspec.Struct, or any other type that msgspec takes. Its `__post_init__` may raise a ValueError.
        next_step: ends the message, unless that error says its own.
        strict: False takes texts for numbers, as in the query of an address.

    Raises:
        ValueError: the value does not fit; says the path to it, what was expected and what came.
    """
    try:
        return msgspec.convert(value, kind, strict=strict)
    except msgspec.ValidationError as error:
        raise ValueError(_explained(str(error), value, kind, next_step)) from None


def shown(value: object, most: int = 200) -> str:
    """A value as JSON has it, cut where it is long."""
    text = json.dumps(value)
    return text if len(text) <= most else text[: most - 3] + "..."


def _without_nulls(value: dict[str, Any]) -> dict[str, Any]:
    """The object without the keys that are null."""
    return {key: item for key, item in value.items() if item is not None}


def _number(text: str) -> float | int:
    """A number with a point or an exponent; a whole one as an integer."""
    value = float(text)
    return int(value) if abs(value) <= LARGEST_INTEGER and value.is_integer() else value


def _explained(error: str, value: Any, kind: Any, next_step: str) -> str:
    """The message of msgspec with the path in plain words, and with the value that came."""
    error, _, path = error.partition(" - at `$")
    place, got = _follow(value, path)
    text = error
    if missing := re.fullmatch(r"Object missing required field `(.*)`", error):
        place, text = f"{place}{missing[1]}: ", "expected a value, got nothing"
        next_step = "add the key"
    elif unknown := re.fullmatch(r"Object contains unknown field `(.*)`", error):
        text = f"expected keys among {', '.join(kind.__struct_fields__)}, got '{unknown[1][:40]}'"
    elif wanted := re.fullmatch(r"Expected (.*?)(, got [^,]*)?", error, re.DOTALL):
        text = f"expected {_in_plain_words(wanted[1])}, got {shown(got, 80)}"
    elif error.startswith("Invalid value") and (tags := [part.__struct_config__.tag for part in get_args(kind)]):
        text = f"expected {' or '.join(tags)}, got {shown(got, 80)}"
    elif re.match(r"Invalid |Number out of range", error):
        text = f"expected another value, got {shown(got, 80)}"
    return f"{place}{text}" if ";" in text else f"{place}{text}; {next_step}"


def _follow(value: Any, path: str) -> tuple[str, Any]:
    """The path in words ("camera 'b': K[0][2]: ") and the value that it leads to."""
    place = ""
    for key, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        value = value.get(key) if key else value[int(index)]
        place += f": {key}" if key else f"[{index}]"
        if index and isinstance(value, dict) and isinstance(name := value.get("name"), str) and name:
            place = re.sub(r"(\w+?)s?\[\d+\]$", lambda plural, name=name: f"{plural[1]} '{name[:40]}'", place)
    return f"{place.removeprefix(': ')}: " if place else "", value


def _in_plain_words(expected: str) -> str:
    expected = re.sub(r"`float` [<>]= -?1e\+300", "a finite number", expected)
    expected = re.sub(r"`str` matching regex '\^\((.*)\)\\\\Z'", lambda words: words[1].replace("|", " or "), expected)
    expected = expected.replace("of length >= 1", "that is not empty")
    return re.sub(r"`([^`]*)`", _kinds_in_plain_words, expected)


def _kinds_in_plain_words(kinds: re.Match[str]) -> str:
    return " or ".join(PLAIN_NAMES.get(kind, kind) for kind in kinds[1].split(" | ") if kind != "null")
