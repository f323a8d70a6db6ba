"""Reads numbers, strings, lists, dicts and arrays from pickles and from NumPy's object files.

Python's unpickler runs with stand-ins for the few functions that arrays and numbers need. Nothing
is imported, and no other function is called: any other name is rejected.
"""

import io
import pickle
import pickletools
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from viewmend.utils.untrusted_input import bounded_bytes

MAX_BYTES = 2**28
"""The annotations of ZJU-MoCap have a few megabytes."""
MAX_STEPS = 1000
"""Limit of a search through nested lists, which may contain themselves."""
KINDS = "fiub"
"""Kinds of numbers that arrays may have."""


class Stored:
    """An array or a dtype; its state follows in the pickle."""

    def __init__(self, dtype: np.dtype | None = None, value: Any = None) -> None:
        self.dtype = dtype
        self.value = value

    def __setstate__(self, state: Any) -> None:
        if self.dtype is None:
            _, shape, dtype, fortran, data = state
            self.value = _make_array(data, dtype, shape, "F" if fortran else "C")
        elif (order := _text(state[1])) in "<>":
            self.dtype = self.dtype.newbyteorder(order)  # pyrefly: ignore[bad-argument-type]


def read_objects(file: Path) -> Any:
    """Read a `.pkl`, or a `.npy` with one object. Arrays are returned as `Stored`, for `numbers`.

    Raises:
        ValueError: it is another file, is too large, or has values of other types.
        OSError: it cannot be read.
    """
    data = bounded_bytes(file, MAX_BYTES)
    try:
        if not data.startswith(b"\x93NUMPY"):
            return _execute(data)
        start = 10 if data[6] == 1 else 12  # the header follows its length
        end = start + int.from_bytes(data[8:start], "little")
        if not re.search(rb"'descr': '\|?O'.*'shape': \(\)", data[start:end]):
            raise ValueError(f"an array with the header {data[start:end][:60].decode(errors='replace')}")
        return unwrap(_execute(data[end:]))
    except Exception as error:  # damaged pickles raise almost any
        got = str(error).strip()[:100] or type(error).__name__
        raise ValueError(
            f"expected numbers, strings, lists, dicts and arrays in {file.name}, got {got}; is it the right file?"
        ) from None


def unwrap(value: Any) -> Any:
    """The object in an array with one object; any other value unchanged."""
    if isinstance(value, Stored) and isinstance(value.value, list) and len(value.value) == 1:
        return value.value[0]
    return value


def numbers(value: Any, *shape: int) -> np.ndarray:
    """Convert a stored array, a number, or nested lists of them to an array of this shape.

    Raises:
        ValueError: it has other values, or another number of them.
    """
    count = int(np.prod(shape))
    found = []
    pending = [value]
    for _ in range(MAX_STEPS):
        if not pending or len(found) > count:
            break
        one = pending.pop()
        one = one.value if isinstance(one, Stored) else one
        if isinstance(one, list | tuple):
            pending += reversed(one[: count + 1])
        elif isinstance(one, np.ndarray):
            found += one.ravel()[: count + 1].tolist()
        elif isinstance(one, int | float):
            found.append(one)
        else:
            raise ValueError(
                f"expected {count} numbers, got {type(one).__name__}; export the calibration again"
            )
    if len(found) != count or pending:
        raise ValueError(
            f"expected {count} numbers, got {len(found) if not pending else 'more'}; export it again"
        )
    return np.array(found, float).reshape(shape)


def _execute(data: bytes) -> Any:
    """The value of a pickle."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # raised for invalid escapes in strings
        # Lengths are checked before memory is allocated for them
        for opcode, argument, _ in pickletools.genops(data):
            if "PUT" in opcode.name and (argument or 0) > len(data):
                raise ValueError(f"the memo {argument}")
        return _Unpickler(io.BytesIO(data), encoding="latin-1").load()


class _Unpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> Any:
        """The stand-in for a function; ValueError for all others."""
        name = f"{module_name.replace('numpy._core', 'numpy.core')[:40]}.{global_name[:40]}"
        stand_in = _stand_ins().get(name)
        if stand_in is None:
            raise ValueError(name)
        return _StandIn(stand_in)


class _StandIn:
    """A function that a pickle can call, and do nothing else with."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, _: Any) -> None:
        raise ValueError("the state of a function")


def _text(value: Any) -> str:
    """The value if it is text: nested lists that share their items would be endless as text."""
    if not isinstance(value, str):
        raise ValueError(f"text of type {type(value).__name__}")
    return value


def _dtype(text: Any, *_: Any) -> Stored:
    dtype = np.dtype("O" if _text(text) == "O8" else text)
    if dtype.kind not in KINDS + "O" or dtype.shape:
        raise ValueError(f"an array of {dtype}")
    return Stored(dtype)


def _make_array(data: Any, dtype: Any, shape: Any, order: str) -> Any:
    kind = dtype.dtype if isinstance(dtype, Stored) else None
    if isinstance(data, list) and kind == np.dtype("O"):
        return data
    if isinstance(data, str):  # from Python 2
        data = data.encode("latin-1")
    if kind is None or kind.kind not in KINDS or not isinstance(data, bytes | bytearray):
        raise ValueError("an array of something else")
    return np.frombuffer(data, kind).reshape(shape, order="F" if order == "F" else "C")


def _stand_ins() -> dict[str, Callable[..., Any]]:
    """What runs instead of the functions that a pickle may name."""
    return {
        "numpy.ndarray": Stored,
        "numpy.dtype": _dtype,
        "numpy.core.multiarray._reconstruct": lambda *_: Stored(),
        "numpy.core.multiarray.scalar": lambda dtype, data: _make_array(data, dtype, (), "C").item(),
        "numpy.core.numeric._frombuffer": lambda *given: Stored(value=_make_array(*given)),
        "_codecs.encode": lambda text, *_: _text(text).encode("latin-1"),
        "collections.OrderedDict": dict,
        "builtins.bytes": lambda: b"",
        "__builtin__.bytes": lambda: b"",
    }
