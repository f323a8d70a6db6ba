"""Samples on disk: one safetensors file each; many of them in tar shards. Nothing is pickled."""

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

from viewmend.atomic_writes import HALF, write_atomically
from viewmend.foreign_input import InputError
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.inpainting.context import ContextFrame
from viewmend.inpainting.correspondences import Correspondences
from viewmend.inpainting.sweep.lookup import Scale
from viewmend.inpainting.sweep.pyramids import Pyramid, Rig
from viewmend.training.encoded import EncodedContext
from viewmend.training.ray_batches import RayBatch
from viewmend.training.samples import Sample
from viewmend.training.stored_scenes import StoredScene, StoredView
from viewmend.training.whole_views import WholeView
from viewmend.views import ContextViews, IncompleteView, MultiViewFrame, Silhouettes, WindowPart

PARTS = (Sample, IncompleteView, ContextViews, WindowPart, MultiViewFrame, Silhouettes, Cameras, Bounds, RayBatch)
STORED = (StoredScene, StoredView, WholeView, Rig, Scale, Pyramid, Correspondences, EncodedContext, ContextFrame)
Trained = Sample | RayBatch | WholeView
Stored = Trained | StoredScene
KINDS = {kind.__name__: kind for kind in (*PARTS, *STORED)}
"""The dataclasses that a sample is made of, and what is looked up of one."""
RENAMED = {"nearby": "ray_views"}
"""Fields by the names of earlier versions."""
PACKED, FASTEST = ".z", 1
"""How names of files end that zlib packed: windows, most of which is black or flat; and its level."""
STRUCTURE = "structure"
"""Name of the tensor that holds the sample without its tensors, as JSON."""


class ShardError(InputError):
    """Samples that cannot be read: which file, what was expected, what came, the next step."""


def sample_to_bytes(sample: Stored) -> bytes:
    """A safetensors file with the sample's tensors, and the rest of it as JSON in a tensor of bytes."""
    tensors: dict[str, torch.Tensor] = {}
    structure = json.dumps(_taken_apart(sample, tensors)).encode()
    tensors[STRUCTURE] = torch.frombuffer(bytearray(structure), dtype=torch.uint8)
    return save(tensors)


def sample_from_bytes(data: bytes) -> Stored:
    """Inverse of `sample_to_bytes`.

    Raises:
        ShardError: these bytes are no sample.
    """
    try:
        tensors = load(data)
        sample = _put_together(json.loads(bytes(tensors.pop(STRUCTURE).tolist())), tensors)
    except (SafetensorError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        said = " ".join(str(error).split())[:200]
        raise ShardError(
            f"expected a sample, got {len(data)} bytes that do not read ({said}); make it again"
        ) from error
    if not isinstance(sample, Stored):
        raise ShardError(f"expected a sample, got a {type(sample).__name__}; make it again")
    return sample


def write_shards(samples: Iterable[Stored], folder: Path, per_shard: int = 48, first: int = 0) -> Iterator[Path]:
    """Tar files of so many samples each, shard-00000.tar (or number `first`) and on; yields their paths.

    Every file is whole or not there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    left = iter(samples)
    shards = iter(lambda: list(islice(left, per_shard)), [])
    for number, shard in enumerate(shards, first):
        yield _write_shard(shard, folder / f"shard-{number:05d}.tar")


def shards_of(folder: Path) -> list[Path]:
    """The shards of a folder, by name; what is still being written, or was left so, is none."""
    return sorted(path for path in folder.glob("*.tar") if not path.name.startswith(HALF))


def read_shard(path: Path, member: int | None = None) -> list[Stored]:
    """All samples of a shard; or this one alone, none where there are fewer.

    Raises:
        ShardError: the file is damaged.
    """
    try:
        with tarfile.open(path, "r:") as tar:  # uncompressed, so that it says no more than it holds
            members = tar.getmembers()
            odd = [each.name for each in members if not each.isreg() or each.sparse or each.size > path.stat().st_size]
            if odd:
                raise ShardError(f"{odd[0]!r} is no plain file within it")
            wanted = members if member is None else members[member : member + 1]
            files = [(each.name.endswith(PACKED), tar.extractfile(each)) for each in wanted]
            read = [(packed, file.read()) for packed, file in files if file is not None]
            return [sample_from_bytes(zlib.decompress(data) if packed else data) for packed, data in read]
    except (tarfile.TarError, OSError, zlib.error, ShardError) as error:
        raise ShardError(f"{path}: expected a tar of samples ({error}); make this shard again") from error


Kind = TypeVar("Kind", bound=Stored)


class ShardScenes(Generic[Kind]):
    """Shards as scenes, in another order each time all were used, and their samples too."""

    def __init__(self, folder: Path, seed: str, kinds: tuple[type[Kind], ...], clip: int = 1) -> None:
        """Find the shards, which hold these kinds alone, samples of `clip` times or more.

        Raises:
            ShardError: the folder has none.
        """
        self.paths = shards_of(folder)
        self.seed = seed
        self.kinds, self.clip = kinds, clip
        if not self.paths:
            raise ShardError(f"{folder}: expected tar files, found none; make some with `viewmend samples --out`")

    def scene(self, number: int) -> list[Kind]:
        """One shard.

        Raises:
            ShardError: it is damaged, or holds another kind, or shorter clips.
        """
        round_, position = divmod(number, len(self.paths))
        order = Random(f"{self.seed}/shards/{round_}").sample(self.paths, len(self.paths))
        found = read_shard(order[position])
        samples = [s for s in found if isinstance(s, self.kinds)]
        if len(samples) < len(found):
            wanted, got = (
                " and ".join(sorted(names))
                for names in ({kind.__name__ for kind in self.kinds}, {type(s).__name__ for s in found})
            )
            raise ShardError(
                f"{order[position]}: expected {wanted}, got {got}; make samples for this recipe "
                "(viewmend samples --recipe)"
            )
        shortest = min((len(s.clip) for s in samples if isinstance(s, Sample)), default=self.clip)
        if shortest < self.clip:
            raise ShardError(
                f"{order[position]}: expected clips of {self.clip} times, got {shortest}; make samples for this recipe "
                f"(viewmend samples RECIPE, or --clip-length {self.clip})"
            )
        return Random(f"{self.seed}/{number}").sample(samples, len(samples))


class StoredShards:
    """Shards of stored scenes, one scene at a time; shard by shard, in another order each time all were used."""

    def __init__(self, folder: Path, seed: str) -> None:
        """Find the shards.

        Raises:
            ShardError: the folder has none, or the first is damaged.
        """
        self.paths = shards_of(folder)
        self.seed = seed
        if not self.paths:
            raise ShardError(f"{folder}: expected tar files, found none; make some with `viewmend samples views --out`")
        self.scenes_a_shard = len(read_shard(self.paths[0]))

    def scene(self, number: int) -> list[StoredScene]:
        """One scene; none where a shard has fewer than the first.

        Raises:
            ShardError: its shard is damaged, or holds something else.
        """
        turn, position = divmod(number, len(self.paths) * self.scenes_a_shard)
        shard, member = divmod(position, self.scenes_a_shard)
        order = Random(f"{self.seed}/shards/{turn}").sample(self.paths, len(self.paths))
        found = read_shard(order[shard], member)
        if not all(isinstance(scene, StoredScene) for scene in found):
            raise ShardError(
                f"{order[shard]}: expected stored scenes, got {type(found[0]).__name__}; make some with `viewmend "
                "samples views --out`"
            )
        return [scene for scene in found if isinstance(scene, StoredScene)]


def _write_shard(samples: list[Stored], path: Path) -> Path:
    def write(beside: Path) -> None:
        with tarfile.open(beside, "w") as tar:
            for number, sample in enumerate(samples):
                data, packed = sample_to_bytes(sample), isinstance(sample, Sample) and sample.view.part is not None
                data = zlib.compress(data, FASTEST) if packed else data
                member = tarfile.TarInfo(f"{path.stem}-{number:04d}.safetensors{PACKED if packed else ''}")
                member.size = len(data)
                tar.addfile(member, io.BytesIO(data))

    write_atomically(path, write)
    return path


def _taken_apart(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    """`value` as JSON can hold it; its tensors, numbered, go to `tensors`."""
    if isinstance(value, torch.Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().contiguous().clone()
        return {"tensor": name}
    if is_dataclass(value):
        parts = {f.name: _taken_apart(getattr(value, f.name), tensors) for f in fields(value)}
        kinds = (kind.__name__ for kind in type(value).__mro__)  # a frame's cameras by reference are stored as copied
        return {"kind": next((kind for kind in kinds if kind in KINDS), type(value).__name__), "fields": parts}
    if isinstance(value, tuple):
        return [_taken_apart(item, tensors) for item in value]
    return value


def _put_together(value: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(value, list):
        return tuple(_put_together(item, tensors) for item in value)
    if isinstance(value, dict) and "tensor" in value:
        return tensors[value["tensor"]]
    if isinstance(value, dict):
        kind = KINDS[value["kind"]]
        parts = {str(RENAMED.get(n, n)): _put_together(part, tensors) for n, part in value["fields"].items()}
        made = kind(**parts)
        if wrong := [name for name, hint in _hints(kind).items() if not _fits(getattr(made, name), hint)]:
            raise TypeError(f"{wrong[0]} of {value['kind']} is of another kind")
        return made
    return value


@cache
def _hints(kind: type) -> dict[str, Any]:
    return {name: hint for name, hint in get_type_hints(kind).items() if name in {f.name for f in fields(kind)}}


def _fits(value: Any, hint: Any) -> bool:
    """Whether a field's value is what its annotation says."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is tuple:
        each = [parts[0]] * len(value) if parts[1:] == (...,) and isinstance(value, tuple) else parts
        return isinstance(value, tuple) and len(value) == len(each) and all(map(_fits, value, each))
    if hint in (int, float):
        return isinstance(value, int | hint) and not isinstance(value, bool)
    return isinstance(value, NoneType if hint is None else hint)
