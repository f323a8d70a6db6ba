"""Values out of a JSON object, each checked, each error naming where it stood."""

import difflib
import json
import math
from collections.abc import Sequence
from typing import overload

import numpy as np
from jaxtyping import Float64

from viewmend.capture.errors import CaptureError

_REQUIRED = object()


class Fields:
    """The keys of one JSON object. `where` says which, in messages; a key that is null counts as absent."""

    def __init__(self, data: object, where: str):
        if not isinstance(data, dict):
            raise CaptureError(f"{where}: expected an object of keys, got {shown(data)}; see the format's description")
        self.data: dict[str, object] = data
        self.where = where

    def wrong(self, key: str, expected: str, got: str, next_step: str) -> CaptureError:
        """The error to raise about a key."""
        return CaptureError(f"{self.where}: {key}: expected {expected}, got {got}; {next_step}")

    def check_spelling(self, known: Sequence[str]) -> None:
        """Unknown keys are notes and pass, unless they look like a known key that is absent (a typo)."""
        absent = [key for key in known if key not in self.data]
        for key in self.data:
            if key not in known:
                close = difflib.get_close_matches(key.lower(), [a.lower() for a in absent], n=1, cutoff=0.8)
                if close:
                    raise self.wrong(key, f"the key '{close[0]}'", f"'{key}'", "rename the key")

    def _get(self, key: str, default: object, expected: str) -> object:
        value = self.data.get(key)
        if value is not None:
            return value
        if default is _REQUIRED:
            raise self.wrong(key, expected, "nothing" if key not in self.data else "null", "add the key")
        return default

    @overload
    def text(self, key: str) -> str: ...
    @overload
    def text(self, key: str, default: None) -> str | None: ...
    def text(self, key: str, default: object = _REQUIRED) -> str | None:
        """A string that is not empty."""
        value = self._get(key, default, "a text")
        if value is None or (isinstance(value, str) and value):
            return value
        raise self.wrong(key, "a text that is not empty", shown(value), "put it in quotes")

    @overload
    def number(self, key: str, default: float) -> float: ...
    @overload
    def number(self, key: str, default: None) -> float | None: ...
    def number(self, key: str, default: object = _REQUIRED) -> float | None:
        """A finite number."""
        value = self._get(key, default, "a number")
        if value is None:
            return None
        if not _is_number(value) or not math.isfinite(value):  # pyright: ignore[reportArgumentType]
            raise self.wrong(key, "a finite number", shown(value), "correct the value")
        return float(value)  # pyright: ignore[reportArgumentType]

    def positive_integer(self, key: str) -> int:
        """A whole number above zero."""
        value = self._get(key, _REQUIRED, "a whole number")
        if not isinstance(value, int) or isinstance(value, bool) or not 0 < value < 2**31:
            raise self.wrong(key, "a whole number above 0", shown(value), "correct the value")
        return value

    def list(self, key: str) -> "list[object]":
        """A list that is not empty."""
        value = self._get(key, _REQUIRED, "a list")
        if not isinstance(value, list) or not value:
            raise self.wrong(key, "a list that is not empty", shown(value), "fill it")
        return value

    @overload
    def array(self, key: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]: ...
    @overload
    def array(
        self, key: str, shape: tuple[int, ...], default: Float64[np.ndarray, "..."]
    ) -> Float64[np.ndarray, "..."]: ...
    @overload
    def array(self, key: str, shape: tuple[int, ...], default: None) -> Float64[np.ndarray, "..."] | None: ...
    def array(self, key: str, shape: tuple[int, ...], default: object = _REQUIRED) -> Float64[np.ndarray, "..."] | None:
        """Finite numbers in nested lists of exactly this shape, always a new array."""
        expected = f"{' x '.join(map(str, shape))} finite numbers"
        value = self._get(key, default, expected)
        if value is None:
            return None
        if isinstance(value, np.ndarray):
            return value.copy()
        if not _has_shape(value, shape):
            raise self.wrong(key, expected, shown(value), "correct the value")
        array = np.array(value, np.float64)
        if not np.isfinite(array).all():
            raise self.wrong(key, expected, shown(value), "calibrate again, or leave the camera out")
        return array


def _is_number(value: object) -> bool:
    return isinstance(value, float) or (isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63)


def _has_shape(value: object, shape: tuple[int, ...]) -> bool:
    if not shape:
        return _is_number(value)
    return isinstance(value, list) and len(value) == shape[0] and all(_has_shape(v, shape[1:]) for v in value)


def shown(value: object) -> str:
    """A value from the file as messages show it: like the file does, cut where it is long."""
    text = json.dumps(value)
    return text if len(text) <= 200 else text[:197] + "..."
