"""Mutated inputs, and the limits that every parser must keep."""

import copy
import gc
import itertools
import json
import os
import resource
import struct
from collections.abc import Callable
from pathlib import Path

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

INPUTS = int(os.environ.get("VIEWMEND_FUZZ", "60"))
MAX_S, MAX_MB = 5.0, 600
COLLECT_EVERY = 64
"""Inputs between garbage collections: networks are cycles of few objects, which Python collects too late."""
FUZZED = settings(
    max_examples=INPUTS,
    deadline=None,
    database=None,
    derandomize=INPUTS < 1000,
    suppress_health_check=list(HealthCheck),
)
NUMBERS = (-1, 0, 1, 2, 0.5, 7, 2**31, 2**40, 10**400, 1e308, -1e308, 1e-300, float("nan"), float("inf"))
TEXTS = ("", "x", "\0", "../../etc/passwd", "/etc/passwd", "/dev/zero", "\ud800", "a" * 5000)
VALUES = st.sampled_from([None, True, *NUMBERS, *TEXTS, [], {}, [[]], {"a": {}}, [0] * 100, ["x"] * 3])
WORDS = ("", "nan", "1e308", "-1", "999999999", "{", "}", "ROOT", "CHANNELS", "w", "\0")


@st.composite
def mutated_json(draw, value):
    """JSON with one to three values replaced, removed, repeated or deeply nested."""
    value, many = copy.deepcopy(value), 3000
    for _ in range(draw(st.integers(1, 3))):
        at, key = value, None
        while isinstance(at, dict | list) and at and (key is None or draw(st.integers(0, 3))):
            parent, key = at, draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
            at = parent[key]
        if key is None:
            return copy.deepcopy(draw(VALUES))  # a copy, since the next iteration may change it
        kind = draw(st.sampled_from(["value", "value", "remove", "repeat", "deep"]))
        if kind == "remove":
            del parent[key]
        elif kind == "repeat" and isinstance(parent, list):
            copies = draw(st.sampled_from([1, many]))
            parent.extend([at] * copies)
            many = 1 if copies > 1 else many  # repeating lists of repeated lists would take all memory
        else:
            parent[key] = (
                copy.deepcopy(draw(VALUES))
                if kind != "deep"
                else nested(draw(st.sampled_from([3, 900, 5000])))
            )
    return value


def nested(depth):
    """A list in a list in a list, and so on."""
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


def to_json(value) -> bytes:
    """JSON as bytes; brackets for a value that is too deep for Python's own writer."""
    try:
        return json.dumps(value).encode(errors="replace")
    except RecursionError:
        return b"[" * 100_000


class File(bytes):
    """Bytes with a short representation."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes that start with {self[:80]!r}>"


@st.composite
def mutated_bytes(draw, data: bytes):
    """Bytes with one to four changes: bytes flipped, removed or repeated, the end cut off, a number overwritten."""
    data = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(data) - 1)))
        kind = draw(st.sampled_from(["flip", "flip", "remove", "end", "repeat", "number"]))
        if kind == "flip" and data:
            data[at] = draw(st.integers(0, 255))
        elif kind == "remove":
            del data[at : at + draw(st.integers(1, 40))]
        elif kind == "end":
            del data[at:]
        elif kind == "repeat":
            data[at:at] = data[at : at + 60]
        else:
            data[at : at + 4] = struct.pack("<I", draw(st.sampled_from([0, 1, 2**31, 2**32 - 1])))
    return bytes(data)


@st.composite
def mutated_words(draw, text: str):
    """Text with one to three words replaced."""
    words = text.split(" ")
    for _ in range(draw(st.integers(1, 3))):
        words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(WORDS))
    return " ".join(words).encode()


def fuzz(
    inputs, read: Callable[[bytes], object], refusals: tuple[type[Exception], ...] = (ValueError,)
) -> None:
    """Check that each input is read or rejected with a short message, in limited time and memory."""
    numbers = itertools.count()

    @FUZZED
    @given(inputs)
    def check(data):
        if next(numbers) % COLLECT_EVERY == 0:
            gc.collect()
        before = resource.getrusage(resource.RUSAGE_SELF)
        try:
            read(data)
        except refusals as error:
            assert len(str(error)) < 2000, str(error)[:3000]
            assert "Error:" not in str(error)[:20]
        after = resource.getrusage(resource.RUSAGE_SELF)
        assert after.ru_utime - before.ru_utime < MAX_S, "too slow"
        assert (after.ru_maxrss - before.ru_maxrss) / 1000 < MAX_MB, "too much memory"

    check()


def fuzz_file(file: Path, read: Callable[[], object], inputs=None, refusals=(ValueError,)) -> None:
    """`fuzz` the content of a file, which is restored; by default with mutated bytes, or JSON in a JSON file."""
    good = file.read_bytes()
    if inputs is None:
        inputs = mutated_bytes(good)
        if file.suffix == ".json":
            inputs |= mutated_json(json.loads(good)).map(to_json)

    def write_and_read(data):
        file.write_bytes(data)
        read()

    try:
        fuzz(inputs, write_and_read, refusals)
    finally:
        file.write_bytes(good)


def split_tensors(data: bytes) -> tuple[dict, bytes]:
    """The header and the data of a safetensors file."""
    size = struct.unpack_from("<Q", data)[0]
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def join_tensors(header: object, tensors: bytes) -> bytes:
    """Inverse of `split_tensors`."""
    text = to_json(header)
    return File(struct.pack("<Q", len(text)) + text + tensors)
