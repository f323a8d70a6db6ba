"""Numbers, texts, lists, dicts and arrays from pickles and from numpy's files of objects. Nothing is unpickled.

The pickle's instructions are read as data (pickletools) and followed by a machine that knows only these kinds of
values: nothing is imported or called, and whatever else a pickle asks for is refused by its name.
"""

import pickletools
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from viewmend.foreign_input import bounded_bytes

MOST_BYTES = 2**28
"""The largest of these files that is read; ZJU-MoCap's annotations have some megabytes."""
MOST_STEPS = 1000
"""A list may hold itself."""
KINDS = "fiub"
"""Kinds of numbers that arrays may hold."""


class Name(NamedTuple):
    """What a pickle would have imported."""

    module: str
    name: str


class Stored:
    """An array or a type of numbers while it is put together."""

    def __init__(self) -> None:
        self.dtype: np.dtype | None = None
        self.value: Any = None


def read_objects(file: Path) -> Any:
    """What a `.pkl` holds, or a `.npy` with one object in it; arrays are `Stored`, for `numbers`.

    Raises:
        ValueError: it is none, is too large, or holds what is no number, text, list, dict or array.
        OSError: it cannot be read.
    """
    data = bounded_bytes(file, MOST_BYTES)
    try:
        if not data.startswith(b"\x93NUMPY"):
            return _followed(data)
        start = 10 if data[6] == 1 else 12  # where the header begins, after its length
        end = start + int.from_bytes(data[8:start], "little")
        if not re.search(rb"'descr': '\|?O'.*'shape': \(\)", data[start:end]):
            raise ValueError(f"an array with the header {data[start:end][:60].decode(errors='replace')}")
        return unwrapped(_followed(data[end:]))
    except (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError) as error:
        got = str(error).strip()[:100] or type(error).__name__
        raise ValueError(
            f"expected numbers, texts, lists, dicts and arrays in {file.name}, got {got}; is it the right file?"
        ) from None


def unwrapped(value: Any) -> Any:
    """The one object of an array of objects; any other value itself."""
    if isinstance(value, Stored) and isinstance(value.value, list) and len(value.value) == 1:
        return value.value[0]
    return value


def numbers(value: Any, *shape: int) -> np.ndarray:
    """A stored array, a number, or lists of them, as numbers of this shape.

    Raises:
        ValueError: there are others, or not so many.
    """
    count, found, left = int(np.prod(shape)), [], [value]
    for _ in range(MOST_STEPS):
        if not left or len(found) > count:
            break
        one = left.pop()
        if isinstance(one, Stored):
            one = one.value
        if isinstance(one, list | tuple):
            left += reversed(one[: count + 1])
        elif isinstance(one, np.ndarray):
            found += one.ravel()[: count + 1].tolist()
        elif isinstance(one, int | float):
            found.append(one)
        else:
            raise ValueError(f"expected {count} numbers, got {type(one).__name__}; export the calibration again")
    if len(found) != count or left:
        raise ValueError(f"expected {count} numbers, got {len(found) if not left else 'more'}; export it again")
    return np.array(found, float).reshape(shape)


def _followed(data: bytes) -> Any:
    """What the pickle's instructions leave; Python warns of texts in it whose escapes are none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        return _run(data)


def _run(data: bytes) -> Any:
    machine = _Machine()
    for opcode, argument, _ in pickletools.genops(data):
        name = opcode.name
        if name == "STOP":
            return machine.stack.pop()
        if name in _PUSHED:
            machine.stack.append(argument)
        elif (step := _STEPS.get(name)) is not None:
            step(machine, argument)
        elif name not in _IGNORED:
            raise ValueError(f"the instruction {name}")
    raise ValueError("no end")


class _Machine:
    """A pickle's stack and memo."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}

    def mark(self, _: Any) -> None:
        self.marks.append(len(self.stack))

    def since_mark(self) -> list[Any]:
        start = self.marks.pop()
        items, self.stack[start:] = self.stack[start:], []
        return items

    def memoize(self, index: Any) -> None:
        self.memo[len(self.memo) if index is None else index] = self.stack[-1]

    def tuple_of(self, count: int) -> None:
        self.stack[-count:] = [tuple(self.stack[-count:])]

    def append(self, items: list[Any]) -> None:
        into = self.stack[-1]
        if not isinstance(into, list):
            raise ValueError("an addition to what is no list")
        into.extend(items)

    def set_items(self, items: list[Any]) -> None:
        into = self.stack[-1]
        if not isinstance(into, dict):
            raise ValueError("a key of what is no dict")
        into.update(_dict(items))

    def global_name(self, text: str) -> None:
        module, _, name = text.partition(" ")
        self.stack.append(Name(module, name))

    def stack_global(self, _: Any) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        self.stack.append(Name(str(module), str(name)))

    def reduce(self, _: Any) -> None:
        arguments, called = self.stack.pop(), self.stack.pop()
        self.stack.append(_made(called, arguments))

    def build(self, _: Any) -> None:
        state, stored = self.stack.pop(), self.stack[-1]
        if not isinstance(stored, Stored):
            raise ValueError("the state of what is no array")
        if stored.dtype is not None:  # a type of numbers: its state tells the order of bytes
            order = str(state[1])
            stored.dtype = stored.dtype.newbyteorder(order) if order in "<>" else stored.dtype  # pyright: ignore
            return
        _, shape, dtype, fortran, data = state
        stored.value = _array(data, dtype, shape, "F" if fortran else "C")


def _dict(items: list[Any]) -> dict[Any, Any]:
    return dict(zip(items[::2], items[1::2], strict=True))


def _made(called: Any, arguments: Any) -> Any:
    """What a call would give, of the few that arrays and numbers need."""
    if not isinstance(called, Name):
        raise ValueError("a call of what has no name")
    module = called.module.replace("numpy._core", "numpy.core")
    stored = Stored()
    match (module, called.name):
        case ("numpy.core.multiarray", "_reconstruct"):
            return stored
        case ("numpy", "dtype"):
            stored.dtype = np.dtype("O") if arguments[0] in ("O", "O8") else np.dtype(str(arguments[0]))
            if stored.dtype.kind not in KINDS + "O" or stored.dtype.shape:
                raise ValueError(f"an array of {stored.dtype}")
            return stored
        case ("numpy.core.multiarray", "scalar"):
            return _array(arguments[1], arguments[0], (), "C").item()
        case ("numpy.core.numeric", "_frombuffer"):
            data, dtype, shape, order = arguments
            stored.value = _array(data, dtype, shape, order)
            return stored
        case ("_codecs", "encode"):
            return str(arguments[0]).encode("latin-1")
        case ("collections", "OrderedDict"):
            return {}
        case ("builtins" | "__builtin__", "bytes") if not arguments:
            return b""
    raise ValueError(f"{called.module[:40]}.{called.name[:40]}")


def _array(data: Any, dtype: Any, shape: Any, order: str) -> Any:
    kind = dtype.dtype if isinstance(dtype, Stored) else None
    if isinstance(data, list) and kind == np.dtype("O"):
        return data
    if isinstance(data, str):  # of Python 2
        data = data.encode("latin-1")
    if kind is None or kind.kind not in KINDS or not isinstance(data, bytes | bytearray):
        raise ValueError("an array of something else")
    return np.frombuffer(data, kind).reshape(shape, order="F" if order == "F" else "C")


_PUSHED = {"INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4"}
_PUSHED |= {"FLOAT", "BINFLOAT", "STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8"}
_PUSHED |= {"UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "BYTEARRAY8"}
_IGNORED = {"PROTO", "FRAME"}
_STEPS: dict[str, Callable[[_Machine, Any], Any]] = {
    "MARK": _Machine.mark,
    "NONE": lambda m, _: m.stack.append(None),
    "NEWTRUE": lambda m, _: m.stack.append(True),
    "NEWFALSE": lambda m, _: m.stack.append(False),
    "EMPTY_LIST": lambda m, _: m.stack.append([]),
    "EMPTY_DICT": lambda m, _: m.stack.append({}),
    "EMPTY_TUPLE": lambda m, _: m.stack.append(()),
    "LIST": lambda m, _: m.stack.append(m.since_mark()),
    "TUPLE": lambda m, _: m.stack.append(tuple(m.since_mark())),
    "DICT": lambda m, _: m.stack.append(_dict(m.since_mark())),
    "TUPLE1": lambda m, _: m.tuple_of(1),
    "TUPLE2": lambda m, _: m.tuple_of(2),
    "TUPLE3": lambda m, _: m.tuple_of(3),
    "APPEND": lambda m, _: m.append([m.stack.pop()]),
    "APPENDS": lambda m, _: m.append(m.since_mark()),
    "SETITEM": lambda m, _: m.set_items([m.stack.pop(-2), m.stack.pop()]),
    "SETITEMS": lambda m, _: m.set_items(m.since_mark()),
    "PUT": _Machine.memoize,
    "BINPUT": _Machine.memoize,
    "LONG_BINPUT": _Machine.memoize,
    "MEMOIZE": _Machine.memoize,
    "GET": lambda m, index: m.stack.append(m.memo[index]),
    "BINGET": lambda m, index: m.stack.append(m.memo[index]),
    "LONG_BINGET": lambda m, index: m.stack.append(m.memo[index]),
    "GLOBAL": _Machine.global_name,
    "STACK_GLOBAL": _Machine.stack_global,
    "REDUCE": _Machine.reduce,
    "BUILD": _Machine.build,
}
