"""Files that OpenCV's FileStorage writes: YAML, XML or JSON."""

from pathlib import Path
from typing import Any

import numpy as np

from viewmend.capture.formats.files import bounded_bytes

MOST_BYTES = 2**22
"""The largest of these files that is read; sixty cameras have 50 kB."""


def read_storage(file: Path) -> dict[str, Any]:
    """The matrices, numbers and lists of names of a file that OpenCV wrote, by their keys; the rest is left out.

    Raises:
        ValueError: it is none, or too large.
    """
    import cv2

    text = bounded_bytes(file, MOST_BYTES).decode()
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root, found = storage.root(), {}
        for key in root.keys():  # noqa: SIM118 (it is no dict)
            node = root.getNode(key)
            if key == "names":
                items = [node.at(index) for index in range(node.size())] if node.isSeq() else []
                found[key] = [item.string() or str(int(item.real())) for item in items]
            elif node.isMap():
                found[key] = np.asarray(node.mat(), float).ravel()
            elif node.isInt() or node.isReal():
                found[key] = node.real()
    except (cv2.error, SystemError, TypeError, OverflowError) as error:
        got = str(error).strip().splitlines()[-1][-80:]
        raise ValueError(f"expected OpenCV's YAML or XML in {file.name}, got: {got}; export it again") from None
    return found
