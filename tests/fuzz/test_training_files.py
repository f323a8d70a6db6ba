"""Shards of training samples are read or rejected like any other file."""

import io
import json
import tarfile
from dataclasses import dataclass, replace
from random import Random

import pytest
import torch
from fuzz.inputs import (
    File,
    fuzz,
    fuzz_file,
    join_tensors,
    mutated_bytes,
    mutated_json,
    nested,
    split_tensors,
    to_json,
)
from jaxtyping import UInt8
from safetensors.torch import save
from torch import Tensor

from viewmend.rendering.view import RenderConfig
from viewmend.scenes.held_out import LeaveOneOut
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.config import SceneConfig
from viewmend.training.samples import Sample
from viewmend.training.scenes import Scene
from viewmend.training.shards import (
    KINDS,
    STRUCTURE,
    ShardError,
    ShardScenes,
    _take_apart,
    read_shard,
    sample_from_bytes,
    sample_to_bytes,
    write_shards,
)
from viewmend.training.stored_scenes import StoredScene, store_scene


@pytest.fixture(scope="module")
def stored() -> StoredScene:
    studio = Studio(StudioConfig(seed=3, cameras=4, frames=1, size_px=48))
    rig = LeaveOneOut({0: studio.read(0)})
    return store_scene(Scene(rig, Random(0)), SceneConfig(num_holdout_views=1, hull_resolution=24))


@pytest.fixture(scope="module")
def sample(stored) -> Sample:
    return stored.sample(0, RenderConfig(), 2)


def with_structure(data: bytes, structure: object) -> bytes:
    """The sample with another structure."""
    head, tensors = split_tensors(data)
    text = to_json(structure)
    begin, end = head[STRUCTURE]["data_offsets"]
    rest = {name: entry for name, entry in head.items() if name != STRUCTURE}
    moved = {
        name: entry
        | {"data_offsets": [at - (end - begin if at >= end else 0) for at in entry["data_offsets"]]}
        for name, entry in rest.items()
    }
    tensors = tensors[:begin] + tensors[end:]
    moved[STRUCTURE] = {
        "dtype": "U8",
        "shape": [len(text)],
        "data_offsets": [len(tensors), len(tensors) + len(text)],
    }
    return join_tensors(moved, tensors + text)


def structure_of(data: bytes) -> dict:
    head, tensors = split_tensors(data)
    begin, end = head[STRUCTURE]["data_offsets"]
    return json.loads(tensors[begin:end])


@pytest.mark.parametrize("kind", ["sample", "stored"])
def test_samples_in_files(kind, request):
    good = sample_to_bytes(request.getfixturevalue(kind))
    head, tensors = split_tensors(good)
    structure = structure_of(good)
    assert sample_to_bytes(sample_from_bytes(with_structure(good, structure))) == good

    def read(data):
        found = sample_from_bytes(data)
        if isinstance(found, StoredScene):
            found.sample(0, RenderConfig(), 2)

    inputs = mutated_json(structure).map(lambda other: with_structure(good, other)) | mutated_bytes(good).map(
        File
    )
    fuzz(inputs | mutated_json(head).map(lambda other: join_tensors(other, tensors)), read)


def test_fields_of_another_type_are_rejected(sample):
    good = sample_to_bytes(sample)
    for field, value in (("view", None), ("truth", {"tensor": "0"}), ("ray_views", []), ("alpha", 3)):
        structure = structure_of(good)
        structure["fields"][field] = value
        with pytest.raises(ShardError, match=r"expected a sample, got [0-9]+ bytes that cannot be read"):
            sample_from_bytes(with_structure(good, structure))
    with pytest.raises(ShardError, match="cannot be read"):
        sample_from_bytes(with_structure(good, nested(100_000)))


@dataclass(frozen=True)
class Loose:
    """A class whose types are checked only by the reader, as in production."""

    rgb: UInt8[Tensor, "3 height width"]
    alpha: UInt8[Tensor, "height width"] | None = None
    number: int = 0
    share: float = 0.5
    names: tuple[str, ...] = ()
    pair: tuple[int, float] = (1, 0.5)


def to_bytes(value: Loose) -> bytes:
    """The value as `sample_to_bytes` writes samples."""
    tensors: dict[str, Tensor] = {}
    text = to_json(_take_apart(value, tensors))
    return save(tensors | {STRUCTURE: torch.frombuffer(bytearray(text), dtype=torch.uint8)})


def test_every_field_is_checked_against_its_annotation(monkeypatch):
    monkeypatch.setitem(KINDS, "Loose", Loose)
    image = torch.zeros(3, 4, 5, dtype=torch.uint8)
    for fits in ({}, {"alpha": image[0]}, {"names": ("a", "b")}, {"share": 1}):
        assert isinstance(sample_from_bytes(to_bytes(Loose(image, **fits))), Loose)
    for name, value in (
        ("rgb", image.float()),
        ("rgb", image[:2]),
        ("alpha", image[0, 0]),
        ("alpha", 1),
        ("number", 0.5),
        ("number", True),
        ("share", "x"),
        ("names", (1,)),
        ("names", "ab"),
        ("pair", (1, 0.5, 2)),
        ("pair", (0.5, 1)),
    ):
        with pytest.raises(ShardError, match=f"cannot be read \\({name} of Loose"):
            sample_from_bytes(to_bytes(replace(Loose(image, image[0]), **{name: value})))


def test_damaged_stored_scenes_are_refused(stored):
    render, view = RenderConfig(), stored.held[0]
    far = torch.diff(torch.tensor([0, 1, 10**6]), prepend=torch.zeros(1, dtype=torch.int64)).int()
    fewer = stored.frame.without(stored.frame.cameras.names[:1])
    for changes, message in (
        ({"truth": replace(view.truth, mask=None)}, "expected stored images and masks"),
        ({"cameras": view.cameras.select(view.cameras.names[1:])}, "expected stored images and masks"),
        ({"faces": far}, "expected faces of"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(stored, held=(replace(view, **changes),)).sample(0, render, 2)
    with pytest.raises(ValueError, match="expected a scene of 1 views or more, got 0"):
        replace(stored, held=()).sample(0, render, 2)
    with pytest.raises(ValueError, match="expected stored images and masks"):
        replace(stored, frame=fewer).sample(0, render, 2)
    depth = replace(stored.depth, steps=stored.depth.steps[:3])
    with pytest.raises(ValueError, match="expected the depth of every second pixel"):
        replace(stored, depth=depth).sample(0, render, 2)


def test_tars(sample, tmp_path):
    [path] = write_shards([sample], tmp_path)
    good = path.read_bytes()
    headers = mutated_bytes(good[:1024]).map(lambda head: head + good[1024:])
    fuzz_file(path, lambda: read_shard(path), (headers | mutated_bytes(good)).map(File))


@pytest.mark.parametrize("how", ["link", "folder", "compressed", "truncated"])
def test_tars_contain_only_plain_files(how, sample, tmp_path):
    data, path = sample_to_bytes(sample), tmp_path / "shard-00000.tar"
    with tarfile.open(path, "w:gz" if how == "compressed" else "w") as tar:
        member = tarfile.TarInfo("a.safetensors")
        member.size = 10**12 if how == "truncated" else len(data)
        member.type = {"link": tarfile.SYMTYPE, "folder": tarfile.DIRTYPE}.get(how, tarfile.REGTYPE)
        member.linkname = "/etc/passwd"
        if how == "truncated":
            tar.fileobj.write(member.tobuf() + data)
        else:
            tar.addfile(member, io.BytesIO(data))
    with pytest.raises(ShardError, match=r"shard-00000\.tar: expected a tar of samples"):
        read_shard(path)


def test_unfinished_shards_are_ignored(sample, stored, tmp_path):
    list(write_shards([sample], tmp_path / "samples"))
    list(write_shards([stored], tmp_path / "scenes"))
    for folder in ("samples", "scenes"):
        (tmp_path / folder / ".half-77-shard-00001.tar").write_bytes(b"half")
    scenes, whole = (
        ShardScenes(tmp_path / "samples", "0", Sample),
        ShardScenes(tmp_path / "scenes", "0", StoredScene, whole=False),
    )
    assert [path.name for path in (*scenes.paths, *whole.paths)] == ["shard-00000.tar"] * 2
    assert len(scenes.scene(1)) == len(whole.scene(1)) == 1
