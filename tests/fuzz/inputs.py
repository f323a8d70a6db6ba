"""Inputs that strangers might give, and the bounds that whoever reads them keeps."""

import copy
import gc
import json
import os
import resource
import struct
from collections.abc import Callable
from dataclasses import dataclass

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

INPUTS = int(os.environ.get("VIEWMEND_FUZZ", "60"))
MOST_S, MOST_MB = 5.0, 600
COLLECT_EVERY = 64
"""After so many inputs of a parser, garbage is looked for: 5,000 networks would take all memory before Python does."""
FUZZED = settings(
    max_examples=INPUTS,
    deadline=None,
    database=None,
    derandomize=INPUTS < 1000,
    suppress_health_check=list(HealthCheck),
)
NUMBERS = (-1, 0, 1, 2, 0.5, 7, 2**31, 2**40, 10**400, 1e308, -1e308, 1e-300, float("nan"), float("inf"))
TEXTS = ("", "x", "\0", "../../etc/passwd", "/etc/passwd", "/dev/zero", "\ud800", "a" * 5000)
NASTY = st.sampled_from([None, True, *NUMBERS, *TEXTS, [], {}, [[]], {"a": {}}, [0] * 100, ["x"] * 3])
WORDS = ("", "nan", "1e308", "-1", "999999999", "{", "}", "ROOT", "CHANNELS", "w", "\0")


@dataclass
class Tried:
    """What a parser was given, and what that took."""

    inputs: int = 0
    read: int = 0
    """Inputs that were no fault; the others were refused."""
    worst_s: float = 0.0
    """Of the processor."""
    worst_mb: float = 0.0
    """By which the process grew beyond all that it had needed before."""
    failures: int = 0


TRIED: dict[str, Tried] = {}
"""By test."""


@st.composite
def changed(draw, value):
    """JSON with one to three of its values replaced, removed, doubled or put where another was."""
    value, many = copy.deepcopy(value), 3000
    for _ in range(draw(st.integers(1, 3))):
        at, key = value, None
        while isinstance(at, dict | list) and at and (key is None or draw(st.integers(0, 3))):
            parent, key = at, draw(st.sampled_from(sorted(at) if isinstance(at, dict) else range(len(at))))
            at = parent[key]
        if key is None:
            return copy.deepcopy(draw(NASTY))  # which the next round may change
        kind = draw(st.sampled_from(["nasty", "nasty", "remove", "double", "deep"]))
        if kind == "remove":
            del parent[key]
        elif kind == "double" and isinstance(parent, list):
            copies = draw(st.sampled_from([1, many]))
            parent.extend([at] * copies)
            many = 1 if copies > 1 else many  # lists within so many lists would take all memory before they are read
        else:
            parent[key] = (
                copy.deepcopy(draw(NASTY)) if kind != "deep" else nested(draw(st.sampled_from([3, 900, 5000])))
            )
    return value


def nested(depth):
    value: list = []
    for _ in range(depth):
        value = [value]
    return value


def text_of(value) -> bytes:
    """JSON as bytes; of what is too deep for Python's own writer, brackets."""
    try:
        return json.dumps(value).encode(errors="replace")
    except RecursionError:
        return b"[" * 100_000


class File(bytes):
    """Bytes that are too many to be shown."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes that begin with {self[:80]!r}>"


@st.composite
def spoilt(draw, data: bytes):
    """Bytes with a few of them changed, a piece cut out, doubled, or nothing after it."""
    data = bytearray(data)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(0, len(data) - 1)))
        kind = draw(st.sampled_from(["flip", "flip", "cut", "end", "double", "number"]))
        if kind == "flip" and data:
            data[at] = draw(st.integers(0, 255))
        elif kind == "cut":
            del data[at : at + draw(st.integers(1, 40))]
        elif kind == "end":
            del data[at:]
        elif kind == "double":
            data[at:at] = data[at : at + 60]
        else:
            data[at : at + 4] = struct.pack("<I", draw(st.sampled_from([0, 1, 2**31, 2**32 - 1])))
    return bytes(data)


@st.composite
def reworded(draw, text: str):
    """Text with a few words replaced."""
    words = text.split(" ")
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(words) - 1))
        words[at] = draw(st.sampled_from(WORDS))
    return " ".join(words).encode()


def held(read: Callable[[], object], refusals: tuple[type[Exception], ...] = (ValueError,)) -> None:
    """Read or refuse, in one line, within the bounds."""
    tried = TRIED.setdefault(os.environ["PYTEST_CURRENT_TEST"].split(" ")[0].split("::")[1], Tried())
    if tried.inputs % COLLECT_EVERY == 0:
        gc.collect()  # networks are cycles, which Python counts as few small things
    began, before = own_time_s(), peak_mb()
    tried.inputs, tried.failures = tried.inputs + 1, tried.failures + 1
    try:
        read()
        tried.read += 1
    except refusals as error:
        assert len(str(error)) < 2000, str(error)[:3000]
        assert "Error:" not in str(error)[:20]
    taken_s, grown_mb = own_time_s() - began, peak_mb() - before
    tried.worst_s, tried.worst_mb = max(tried.worst_s, taken_s), max(tried.worst_mb, grown_mb)
    assert taken_s < MOST_S, "too slow"
    assert grown_mb < MOST_MB, "too much memory"
    tried.failures -= 1


def own_time_s() -> float:
    """Seconds that the processor spent on our instructions: how long a system takes to hand out pages is not ours."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_utime


def peak_mb() -> float:
    """The most memory that this process has ever had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000


def parts_of(data: bytes) -> tuple[dict, bytes]:
    """A safetensors file's head, and its tensors."""
    size = struct.unpack_from("<Q", data)[0]
    return json.loads(data[8 : 8 + size]), data[8 + size :]


def joined(head: object, tensors: bytes) -> bytes:
    """Inverse of `parts_of`."""
    text = text_of(head)
    return File(struct.pack("<Q", len(text)) + text + tensors)
