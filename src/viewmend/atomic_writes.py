"""Files that are whole or not there: written beside their place, then renamed."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """`write` a file beside `path`, which then takes its place; nobody ever sees half a file.

    Raises:
        OSError: it cannot be written; what was at `path` is as it was.
    """
    beside = path.with_name(f".half-{os.getpid()}-{path.name}")
    try:
        write(beside)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """A safetensors file, whole or not there; tensors are taken from any device.

    Raises:
        OSError: it cannot be written.
    """
    plain = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}

    def write(beside: Path) -> None:
        try:
            save_file(plain, beside, dict(metadata))
        except SafetensorError as error:
            raise OSError(f"{path}: expected room for the file, got: {error}; free some, or write elsewhere") from error
        beside.chmod(0o644)

    write_atomically(path, write)
