"""Files that OpenCV's FileStorage writes: YAML, XML or JSON.

They are not read by OpenCV: its parser ends the process on some spoilt files.
"""

import math
import shlex
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import yaml

from viewmend.capture.formats.xml import read_xml
from viewmend.foreign_input import bounded_bytes

MOST_BYTES = 2**20
"""The largest of these files that is read; sixty cameras have 50 kB."""
LOADER = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
"""Makes text of every number, so that a camera named 00 keeps its name; libyaml's, where PyYAML was built with it."""


def read_storage(file: Path) -> dict[str, Any]:
    """The matrices (flat), numbers and lists of names of a file that OpenCV wrote, by their keys; the rest is left out.

    Raises:
        ValueError: it is none, too large, or a matrix has not as many numbers as it says.
    """
    data = bounded_bytes(file, MOST_BYTES)
    if data.lstrip().startswith(b"<"):
        entries = {child.tag: _entry(child) for child in read_xml(data)}
    else:
        entries = _read_yaml(data.decode(), file.name)
    found = {}
    for key, value in entries.items():
        if key == "names":
            found[key] = [name for name in value if isinstance(name, str)] if isinstance(value, list) else []
        elif isinstance(value, dict):
            if {"rows", "cols", "data"} <= value.keys():
                found[key] = _matrix(key, value)
        elif (number := _number(value)) is not None:
            found[key] = number
    return found


def _read_yaml(text: str, name: str) -> dict[str, Any]:
    """What a YAML or JSON document holds, its numbers as text."""
    head, _, rest = text.partition("\n")
    try:
        entries = yaml.load(rest if head.startswith("%YAML") else text, LOADER)
    except (yaml.YAMLError, RecursionError) as error:
        got = str(getattr(error, "problem", None) or "what is no text or nested too deep")[:80]
        raise ValueError(f"expected OpenCV's YAML or XML in {name}, got: {got}; export it again") from None
    if not isinstance(entries, dict):
        raise ValueError(f"expected OpenCV's YAML or XML in {name}, got no keys; export it again")
    return {str(key): value for key, value in entries.items()}


def _entry(element: Element) -> Any:
    """An element of XML as `_read_yaml` would give it."""
    parts = {child.tag: child.text or "" for child in element}
    if "data" in parts:
        return parts | {"data": parts["data"].split()}
    text = (element.text or "").strip()
    return shlex.split(text) if element.tag == "names" else text


def _matrix(key: str, stored: dict[str, Any]) -> np.ndarray:
    """The numbers of a stored matrix, row by row, `(rows * cols * channels,)`."""
    data, dt = stored["data"], stored.get("dt", "d")
    numbers = [_number(value) for value in data] if isinstance(data, list) else []
    sides = [_number(stored.get("rows")), _number(stored.get("cols"))]
    channels = _number(dt.strip('"')[:-1] or "1") if isinstance(dt, str) else None
    if None in numbers or math.prod(side or 0 for side in (*sides, channels)) != len(numbers):
        got = f"{len(numbers)}, or some that are none"
        raise ValueError(f"{key[:40]}: expected rows x cols numbers, got {got}; export it again")
    return np.array(numbers, float)


def _number(value: object) -> float | None:
    """A number from its text, also YAML's `.Inf` and `.Nan`; None if it is none."""
    try:
        return float(value.lower().replace(".inf", "inf").replace(".nan", "nan")) if isinstance(value, str) else None
    except ValueError:
        return None
