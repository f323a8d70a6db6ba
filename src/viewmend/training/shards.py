"""Samples on disk: a safetensors file for each, and tar files ("shards") of many. Nothing is pickled."""

import io
import json
import tarfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from random import Random
from types import NoneType, UnionType
from typing import Any, Generic, TypeVar, Union, get_args, get_origin, get_type_hints

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.training.samples import Sample
from viewmend.types import ContextViews, IncompleteView, MultiViewFrame, Silhouettes
from viewmend.utils.atomic_writes import TEMPORARY, write_atomically
from viewmend.utils.untrusted_input import InputError

KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (Sample, IncompleteView, ContextViews, MultiViewFrame, Silhouettes, Cameras, Bounds)
}
"""The dataclasses that files may hold, by name; `storable` adds to them."""
COMPRESSION = 1
"""Items are compressed by zlib at this level: most of their pixels are black."""
MAX_BYTES = 2**31
"""Items have at most this many bytes without compression."""
STRUCTURE = "structure"
"""Name of the tensor that holds everything but the tensors, as JSON."""
Kind = TypeVar("Kind")


class ShardError(InputError):
    """Samples that cannot be read: which file, what was expected, what was found, what to do."""


def storable(kind: type[Kind]) -> type[Kind]:
    """Let files hold this dataclass; usable as a decorator."""
    KINDS[kind.__name__] = kind
    return kind


def sample_to_bytes(sample: object) -> bytes:
    """A safetensors file with the tensors of a dataclass, and everything else as JSON in a tensor of bytes."""
    tensors: dict[str, torch.Tensor] = {}
    structure = json.dumps(_take_apart(sample, tensors)).encode()
    tensors[STRUCTURE] = torch.frombuffer(bytearray(structure), dtype=torch.uint8)
    return save(tensors)


def sample_from_bytes(data: bytes) -> Any:
    """Inverse of `sample_to_bytes`.

    Raises:
        ShardError: the bytes are damaged, or hold something that is not one of `KINDS`.
    """
    try:
        tensors = load(data)
        sample = _put_together(json.loads(bytes(tensors.pop(STRUCTURE).tolist())), tensors)
        if type(sample) not in KINDS.values():
            raise TypeError(f"a {type(sample).__name__}")
    except (SafetensorError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ShardError(
            f"expected a sample, got {len(data)} bytes that cannot be read ({reason}); write it again"
        ) from error
    return sample


def write_shards(
    samples: Iterable[object], folder: Path, shard_size: int = 48, first: int = 0
) -> Iterator[Path]:
    """Write tar files of `shard_size` samples, shard-00000.tar (or number `first`) and on; yields their paths.

    Each file is written completely or not at all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    remaining = iter(samples)
    shards = iter(lambda: list(islice(remaining, shard_size)), [])
    for number, shard in enumerate(shards, first):
        yield _write_shard(shard, folder / f"shard-{number:05d}.tar")


def shards_of(folder: Path) -> list[Path]:
    """The shards of a folder, by name, without unfinished ones."""
    return sorted(path for path in folder.glob("*.tar") if not path.name.startswith(TEMPORARY))


def read_shard(path: Path, member: int | None = None) -> list[Any]:
    """All samples of a shard, or only the one at index `member`, if there is one; ShardError if it is damaged."""
    try:
        with tarfile.open(path, "r:") as tar:  # uncompressed, so that it cannot claim more than it holds
            members = tar.getmembers()
            odd = [
                each.name
                for each in members
                if not each.isreg() or each.sparse or each.size > path.stat().st_size
            ]
            if odd:
                raise ShardError(f"{odd[0]!r} is not a plain file")
            wanted = members if member is None else members[member : member + 1]
            files = [file for each in wanted if (file := tar.extractfile(each)) is not None]
            return [
                sample_from_bytes(zlib.decompressobj().decompress(file.read(), MAX_BYTES)) for file in files
            ]
    except (tarfile.TarError, OSError, zlib.error, ShardError) as error:
        raise ShardError(f"{path}: expected a tar of samples ({error}); write this shard again") from error


class ShardScenes(Generic[Kind]):
    """Shards as scenes, in a new random order whenever all have been used."""

    def __init__(
        self, folder: Path, seed: str, kind: type[Kind], whole: bool = True, clip_length: int = 1
    ) -> None:
        """Find the shards. A scene is a whole shard with its samples in random order, or a single item if not `whole`.

        Raises:
            ShardError: there are none, or items are numbered and one shard is not a tar file.
        """
        self.paths = shards_of(folder)
        self.seed = seed
        self.kind = kind
        self.whole = whole
        self.clip_length = clip_length
        if not self.paths:
            raise ShardError(
                f"{folder}: expected tar files, found none; write some with `viewmend make-dataset --out`"
            )
        self._items = 1 if whole else max(1, *map(_count_members, self.paths))

    def scene(self, number: int) -> list[Kind]:
        """One shard; or one item, none where a shard has fewer than the longest.

        Raises:
            ShardError: the shard is damaged, or holds another kind, or shorter clips.
        """
        round_, position = divmod(number, len(self.paths) * self._items)
        shard, item = divmod(position, self._items)
        path = Random(f"{self.seed}/shards/{round_}").sample(self.paths, len(self.paths))[shard]
        found = read_shard(path, None if self.whole else item)
        samples = [sample for sample in found if isinstance(sample, self.kind)]
        if len(samples) < len(found):
            got = " and ".join(sorted({type(sample).__name__ for sample in found}))
            raise ShardError(
                f"{path}: expected {self.kind.__name__}, got {got}; write samples for this recipe with "
                "`viewmend make-dataset RECIPE`"
            )
        shortest = min((len(s.clip) for s in samples if isinstance(s, Sample)), default=self.clip_length)
        if shortest < self.clip_length:
            raise ShardError(
                f"{path}: expected clips of {self.clip_length} frames, got {shortest}; write samples for this recipe "
                "with `viewmend make-dataset RECIPE`"
            )
        return Random(f"{self.seed}/{number}").sample(samples, len(samples))


def _count_members(path: Path) -> int:
    """The number of samples in a shard, which are not read; ShardError if it is not a tar file."""
    try:
        with tarfile.open(path, "r:") as tar:
            return len(tar.getmembers())
    except (tarfile.TarError, OSError) as error:
        raise ShardError(f"{path}: expected a tar of samples ({error}); write this shard again") from error


def _write_shard(samples: list[object], path: Path) -> Path:
    def write(unfinished: Path) -> None:
        with tarfile.open(unfinished, "w") as tar:
            for number, sample in enumerate(samples):
                data = zlib.compress(sample_to_bytes(sample), COMPRESSION)
                member = tarfile.TarInfo(f"{path.stem}-{number:04d}.safetensors.z")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))

    write_atomically(path, write)
    return path


def _take_apart(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """`value` as JSON values; its tensors are numbered and added to `tensors`."""
    if isinstance(value, torch.Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().contiguous().clone()
        return {"tensor": name}
    if is_dataclass(value):
        parts = {f.name: _take_apart(getattr(value, f.name), tensors) for f in fields(value)}
        # A subclass, such as that of lazily selected views, is stored as its base class
        kinds = (kind.__name__ for kind in type(value).__mro__)
        return {
            "kind": next((kind for kind in kinds if kind in KINDS), type(value).__name__),
            "fields": parts,
        }
    if isinstance(value, tuple):
        return [_take_apart(item, tensors) for item in value]
    return value


def _put_together(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """Inverse of `_take_apart`; TypeError if a field has another type than its annotation."""
    if isinstance(value, list):
        return tuple(_put_together(item, tensors) for item in value)
    if isinstance(value, dict) and "tensor" in value:
        return tensors[value["tensor"]]
    if isinstance(value, dict):
        name = value["kind"]
        kind = KINDS[name]
        parts = {str(key): _put_together(part, tensors) for key, part in value["fields"].items()}
        whole = kind(**parts)
        wrong = [field for field, hint in _hints(kind).items() if not _fits(getattr(whole, field), hint)]
        if wrong:
            raise TypeError(f"{wrong[0]} of {name} has another type")
        return whole
    return value


@cache
def _hints(kind: type) -> dict[str, Any]:
    return {
        name: hint for name, hint in get_type_hints(kind).items() if name in {f.name for f in fields(kind)}
    }


def _fits(value: Any, hint: Any) -> bool:
    """Whether a field's value has the type of its annotation."""
    origin = get_origin(hint)
    parts = get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is tuple:
        each = [parts[0]] * len(value) if parts[1:] == (...,) and isinstance(value, tuple) else parts
        return isinstance(value, tuple) and len(value) == len(each) and all(map(_fits, value, each))
    if hint in (int, float):
        return isinstance(value, int | hint) and not isinstance(value, bool)
    return isinstance(value, NoneType if hint is None else hint)
