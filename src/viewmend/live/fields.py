"""JSON from strangers: values are checked when they are taken, each error names what was expected and what came."""

import json
from collections.abc import Sequence
from typing import Any


class ProtocolError(ValueError):
    """A message that is none of ours: what was expected, what came."""


def read_json(text: str | bytes) -> object:
    """JSON without NaN and infinities.

    Raises:
        ProtocolError: it is none.
    """
    try:
        return json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ProtocolError(f"expected JSON, got {str(error)[:80]}") from None


def _refuse(name: str) -> object:
    raise ProtocolError(f"{name}, which JSON has not")


class Fields:
    """A JSON object; null is the same as absent.

    Raises:
        ProtocolError: it is none. So do all that take values.
    """

    def __init__(self, values: object) -> None:
        if not isinstance(values, dict):
            raise ProtocolError(f"expected a JSON object, got {str(values)[:40]!r}")
        self.values: dict[str, Any] = values

    def has(self, key: str) -> bool:
        """Whether there is a value."""
        return self.values.get(key) is not None

    def get(self, key: str, default: object) -> object:
        """The value, unchecked."""
        return self.values[key] if self.has(key) else default

    def number(self, key: str, low: float | int, high: float | int, default: float | int | None = None) -> float:
        """A finite number within bounds."""
        value: Any = self.get(key, default)
        if not _is_number(value) or not low <= value <= high:
            raise ProtocolError(f"expected '{key}' as a number from {low:g} to {high:g}, got {str(value)[:40]!r}")
        return float(value)

    def whole(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """A whole number within bounds."""
        value = self.number(key, low, high, default)
        if value != int(value):
            raise ProtocolError(f"expected '{key}' as a whole number, got {value}")
        return int(value)

    def flag(self, key: str, default: bool) -> bool:
        """True or false."""
        value = self.get(key, default)
        if not isinstance(value, bool):
            raise ProtocolError(f"expected '{key}' as true or false, got {str(value)[:40]!r}")
        return value

    def choice(self, key: str, among: Sequence[str], default: str | None = None) -> str:
        """One of some words."""
        value = self.get(key, default)
        if not isinstance(value, str) or value not in among:
            raise ProtocolError(f"expected '{key}' among {list(among)}, got {str(value)[:40]!r}")
        return value

    def text(self, key: str, default: str | None = None, most: int = 200) -> str:
        """A short text."""
        value = self.get(key, default)
        if not isinstance(value, str) or len(value) > most:
            raise ProtocolError(f"expected '{key}' as a text of at most {most} letters, got {str(value)[:40]!r}")
        return value

    def items(self, key: str, most: int, least: int = 1) -> list[Any]:
        """A list of so many."""
        value = self.get(key, None)
        if not isinstance(value, list) or not least <= len(value) <= most:
            raise ProtocolError(f"expected '{key}' as a list of {least} to {most}, got {str(value)[:40]!r}")
        return value

    def texts(self, key: str, default: tuple[str, ...], most: int, least: int = 1) -> tuple[str, ...]:
        """Some different short texts."""
        if not self.has(key):
            return default
        value = self.items(key, most, least)
        if any(not isinstance(v, str) or len(v) > 40 for v in value):
            raise ProtocolError(f"expected '{key}' as short texts, got {str(value)[:40]!r}")
        return tuple(dict.fromkeys(value))

    def numbers(self, key: str, count: int, most: float | int) -> tuple[float, ...]:
        """So many numbers, none larger."""
        value = self.items(key, count)
        if len(value) != count or not all(_is_number(v) and -most <= v <= most for v in value):
            raise ProtocolError(f"expected '{key}' as {count} numbers within {most:g}, got {str(value)[:60]!r}")
        return tuple(float(v) for v in value)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
