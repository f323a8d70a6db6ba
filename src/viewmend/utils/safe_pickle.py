"""Reads numbers, strings, lists, dicts and arrays from pickles and from NumPy's object files, without unpickling.

The instructions of the pickle are read as data (pickletools) and executed by a small machine that knows only these
values. Nothing is imported or called; any other instruction is rejected by its name.
"""

import pickletools
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from viewmend.utils.untrusted_input import bounded_bytes

MAX_BYTES = 2**28
"""The annotations of ZJU-MoCap have a few megabytes."""
MAX_STEPS = 1000
"""Limit of a search through nested lists, which may contain themselves."""
KINDS = "fiub"
"""Kinds of numbers that arrays may have."""


class Name(NamedTuple):
    """A name that unpickling would import."""

    module: str
    name: str


class Stored:
    """An array or a dtype under construction."""

    def __init__(self) -> None:
        self.dtype: np.dtype | None = None
        self.value: Any = None


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
    except (ValueError, TypeError, IndexError, KeyError, AttributeError, OverflowError) as error:
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
    count, found, pending = int(np.prod(shape)), [], [value]
    for _ in range(MAX_STEPS):
        if not pending or len(found) > count:
            break
        one = pending.pop()
        if isinstance(one, Stored):
            one = one.value
        if isinstance(one, list | tuple):
            pending += reversed(one[: count + 1])
        elif isinstance(one, np.ndarray):
            found += one.ravel()[: count + 1].tolist()
        elif isinstance(one, int | float):
            found.append(one)
        else:
            raise ValueError(f"expected {count} numbers, got {type(one).__name__}; export the calibration again")
    if len(found) != count or pending:
        raise ValueError(f"expected {count} numbers, got {len(found) if not pending else 'more'}; export it again")
    return np.array(found, float).reshape(shape)


def _execute(data: bytes) -> Any:
    """Execute the instructions of a pickle and return its value."""
    machine = _Machine()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # raised for invalid escapes in strings
        for opcode, argument, _ in pickletools.genops(data):
            name = opcode.name
            if name == "STOP":
                return machine.stack.pop()
            if name in _CONSTANTS:
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

    def recall(self, index: Any) -> None:
        self.stack.append(self.memo[index])

    def make_tuple(self, count: int) -> None:
        self.stack[-count:] = [tuple(self.stack[-count:])]

    def extend_list(self, items: list[Any]) -> None:
        target = self.stack[-1]
        if not isinstance(target, list):
            raise ValueError("an item added to something that is not a list")
        target.extend(items)

    def update_dict(self, items: list[Any]) -> None:
        target = self.stack[-1]
        if not isinstance(target, dict):
            raise ValueError("a key of something that is not a dict")
        target.update(_make_dict(items))

    def global_name(self, text: str) -> None:
        module, _, name = text.partition(" ")
        self.stack.append(Name(module, name))

    def stack_global(self, _: Any) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        self.stack.append(Name(str(module), str(name)))

    def reduce(self, _: Any) -> None:
        arguments, called = self.stack.pop(), self.stack.pop()
        self.stack.append(_call(called, arguments))

    def build(self, _: Any) -> None:
        state, stored = self.stack.pop(), self.stack[-1]
        if not isinstance(stored, Stored):
            raise ValueError("the state of something that is not an array")
        if stored.dtype is not None:  # the state of a dtype has its byte order
            order = str(state[1])
            stored.dtype = stored.dtype.newbyteorder(order) if order in "<>" else stored.dtype  # pyright: ignore
            return
        _, shape, dtype, fortran, data = state
        stored.value = _make_array(data, dtype, shape, "F" if fortran else "C")


def _make_dict(items: list[Any]) -> dict[Any, Any]:
    return dict(zip(items[::2], items[1::2], strict=True))


def _call(called: Any, arguments: Any) -> Any:
    """The result of one of the few calls that arrays and numbers need."""
    if not isinstance(called, Name):
        raise ValueError("a call of something without a name")
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
            return _make_array(arguments[1], arguments[0], (), "C").item()
        case ("numpy.core.numeric", "_frombuffer"):
            data, dtype, shape, order = arguments
            stored.value = _make_array(data, dtype, shape, order)
            return stored
        case ("_codecs", "encode"):
            return str(arguments[0]).encode("latin-1")
        case ("collections", "OrderedDict"):
            return {}
        case ("builtins" | "__builtin__", "bytes") if not arguments:
            return b""
    raise ValueError(f"{called.module[:40]}.{called.name[:40]}")


def _make_array(data: Any, dtype: Any, shape: Any, order: str) -> Any:
    kind = dtype.dtype if isinstance(dtype, Stored) else None
    if isinstance(data, list) and kind == np.dtype("O"):
        return data
    if isinstance(data, str):  # from Python 2
        data = data.encode("latin-1")
    if kind is None or kind.kind not in KINDS or not isinstance(data, bytes | bytearray):
        raise ValueError("an array of something else")
    return np.frombuffer(data, kind).reshape(shape, order="F" if order == "F" else "C")


_CONSTANTS = {"INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"}
_CONSTANTS |= {"STRING", "BINSTRING", "SHORT_BINSTRING", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"}
_CONSTANTS |= {"UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"}
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
    "DICT": lambda m, _: m.stack.append(_make_dict(m.since_mark())),
    "TUPLE1": lambda m, _: m.make_tuple(1),
    "TUPLE2": lambda m, _: m.make_tuple(2),
    "TUPLE3": lambda m, _: m.make_tuple(3),
    "APPEND": lambda m, _: m.extend_list([m.stack.pop()]),
    "APPENDS": lambda m, _: m.extend_list(m.since_mark()),
    "SETITEM": lambda m, _: m.update_dict([m.stack.pop(-2), m.stack.pop()]),
    "SETITEMS": lambda m, _: m.update_dict(m.since_mark()),
    "PUT": _Machine.memoize,
    "BINPUT": _Machine.memoize,
    "LONG_BINPUT": _Machine.memoize,
    "MEMOIZE": _Machine.memoize,
    "GET": _Machine.recall,
    "BINGET": _Machine.recall,
    "LONG_BINGET": _Machine.recall,
    "GLOBAL": _Machine.global_name,
    "STACK_GLOBAL": _Machine.stack_global,
    "REDUCE": _Machine.reduce,
    "BUILD": _Machine.build,
}
