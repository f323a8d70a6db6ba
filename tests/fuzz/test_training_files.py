"""Shards, runs and cells of strangers are read or refused like any other file: in one line, soon, in little memory."""

import io
import json
import struct
import tarfile
import zlib
from dataclasses import dataclass, replace
from random import Random

import cv2
import numpy as np
import pytest
import torch
from fuzz.inputs import FUZZED, File, changed, held, joined, nested, parts_of, spoilt, text_of
from hypothesis import given
from jaxtyping import UInt8
from safetensors.torch import save
from torch import Tensor

from viewmend.leave_one_out.scenes import LeaveOneOut
from viewmend.rendering.view import RenderConfig
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.plan import DataPlan
from viewmend.training.sample_files import (
    KINDS,
    STRUCTURE,
    ShardError,
    ShardScenes,
    StoredShards,
    _taken_apart,
    read_shard,
    sample_from_bytes,
    sample_to_bytes,
    write_shards,
)
from viewmend.training.samples import Sample
from viewmend.training.stored_scenes import StoredScene, store


@pytest.fixture(scope="module")
def stored() -> StoredScene:
    studio = Studio(StudioConfig(seed=3, cameras=4, frames=1, size_px=48))
    rig = LeaveOneOut({0: studio.read(0)})
    return store(rig, 0, DataPlan(held_cameras=1, hull_resolution=24), Random(0))


@pytest.fixture(scope="module")
def sample(stored) -> Sample:
    return stored.sample(0, RenderConfig(), 2)


def with_structure(data: bytes, structure: object) -> bytes:
    """The sample with another JSON."""
    head, tensors = parts_of(data)
    text = text_of(structure)
    begin, end = head[STRUCTURE]["data_offsets"]
    rest = {name: entry for name, entry in head.items() if name != STRUCTURE}
    moved = {
        name: entry | {"data_offsets": [at - (end - begin if at >= end else 0) for at in entry["data_offsets"]]}
        for name, entry in rest.items()
    }
    tensors = tensors[:begin] + tensors[end:]
    moved[STRUCTURE] = {"dtype": "U8", "shape": [len(text)], "data_offsets": [len(tensors), len(tensors) + len(text)]}
    return joined(moved, tensors + text)


def structure_of(data: bytes) -> dict:
    head, tensors = parts_of(data)
    begin, end = head[STRUCTURE]["data_offsets"]
    return json.loads(tensors[begin:end])


@pytest.mark.parametrize("kind", ["sample", "stored"])
def test_samples_in_files(kind, request):
    good = sample_to_bytes(request.getfixturevalue(kind))
    head, tensors = parts_of(good)
    structure = structure_of(good)
    assert sample_to_bytes(sample_from_bytes(with_structure(good, structure))) == good

    def read(data):
        found = sample_from_bytes(data)
        if isinstance(found, StoredScene):
            found.sample(0, RenderConfig(), 2)

    @FUZZED
    @given(
        changed(structure).map(lambda other: with_structure(good, other))
        | changed(head).map(lambda other: joined(other, tensors))
        | spoilt(good).map(File)
    )
    def fuzz(data):
        held(lambda: read(data))

    fuzz()


def test_what_is_of_another_size_or_kind_is_no_sample(sample):
    good = sample_to_bytes(sample)
    for field, value in (("view", None), ("truth", {"tensor": "0"}), ("ray_views", []), ("alpha", 3)):
        structure = structure_of(good)
        structure["fields"][field] = value
        with pytest.raises(ShardError, match=r"expected a sample, got [0-9]+ bytes that do not read"):
            sample_from_bytes(with_structure(good, structure))
    with pytest.raises(ShardError, match="do not read"):
        sample_from_bytes(with_structure(good, nested(100_000)))


def test_a_sample_of_an_earlier_version_reads_as_it_was(sample):
    good = sample_to_bytes(sample)
    structure = structure_of(good)
    structure["fields"]["nearby"] = structure["fields"].pop("ray_views")
    assert sample_to_bytes(sample_from_bytes(with_structure(good, structure))) == good


@dataclass(frozen=True)
class Loose:
    """Nothing but the reader looks at the types of this class, as in production."""

    rgb: UInt8[Tensor, "3 height width"]
    alpha: UInt8[Tensor, "height width"] | None = None
    number: int = 0
    share: float = 0.5
    names: tuple[str, ...] = ()
    pair: tuple[int, float] = (1, 0.5)


def written(value: Loose) -> bytes:
    """As `sample_to_bytes` writes samples."""
    tensors: dict[str, Tensor] = {}
    text = text_of(_taken_apart(value, tensors))
    return save(tensors | {STRUCTURE: torch.frombuffer(bytearray(text), dtype=torch.uint8)})


def test_every_field_is_compared_with_what_its_class_says(monkeypatch):
    monkeypatch.setitem(KINDS, "Loose", Loose)
    image = torch.zeros(3, 4, 5, dtype=torch.uint8)
    for fits in ({}, {"alpha": image[0]}, {"names": ("a", "b")}, {"share": 1}):
        with pytest.raises(ShardError, match="expected a sample, got a Loose"):
            sample_from_bytes(written(Loose(image, **fits)))
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
        with pytest.raises(ShardError, match=f"do not read \\({name} of Loose"):
            sample_from_bytes(written(replace(Loose(image, image[0]), **{name: value})))


def test_stored_scenes_say_no_more_than_they_hold(stored):
    render, view = RenderConfig(), stored.held[0]
    tensor = lambda data: torch.frombuffer(bytearray(data), dtype=torch.uint8)  # noqa: E731
    huge = cv2.imencode(".png", np.zeros((8, 8, 4), np.uint8))[1].tobytes()
    huge = huge[:16] + struct.pack(">II", 60_000, 60_000) + huge[24:]
    far = np.diff(np.array([0, 1, 10**6], np.int32), prepend=0).astype(np.int32).tobytes()
    for changes, message in (
        ({"truth": tensor(huge)}, "expected a stored PNG"),
        ({"truth": stored.held[0].depth}, "expected a stored PNG"),
        ({"faces": tensor(zlib.compress(far))}, "expected faces of"),
        ({"vertices": tensor(b"no")}, "expected a stored mesh"),
    ):
        with pytest.raises(ValueError, match=message):
            replace(stored, held=(replace(view, **changes),)).sample(0, render, 2)
    with pytest.raises(ValueError, match="expected a scene of 1 views or more, got 0"):
        replace(stored, held=()).sample(0, render, 2)
    small = tensor(cv2.imencode(".png", np.zeros((8, 8, 4), np.uint8))[1].tobytes())
    with pytest.raises(ValueError, match="of the camera's size"):
        replace(stored, images=(small, *stored.images[1:])).sample(0, render, 2)
    for changes in ({"images": stored.images * 2}, {"images": stored.images[:3]}, {"depths": stored.depths[:3]}):
        with pytest.raises(ValueError, match="expected an image and a depth of 4 cameras"):
            replace(stored, **changes).sample(0, render, 2)


def test_tars(sample, tmp_path):
    [path] = write_shards([sample], tmp_path)
    good = path.read_bytes()

    @FUZZED
    @given((spoilt(good[:1024]).map(lambda head: head + good[1024:]) | spoilt(good)).map(File))
    def fuzz(data):
        path.write_bytes(data)
        held(lambda: read_shard(path))

    fuzz()


@pytest.mark.parametrize("how", ["link", "folder", "compressed", "more than there is"])
def test_a_tar_holds_plain_files_alone(how, sample, tmp_path):
    data, path = sample_to_bytes(sample), tmp_path / "shard-00000.tar"
    with tarfile.open(path, "w:gz" if how == "compressed" else "w") as tar:
        member = tarfile.TarInfo("a.safetensors")
        member.size = 10**12 if how == "more than there is" else len(data)
        member.type = {"link": tarfile.SYMTYPE, "folder": tarfile.DIRTYPE}.get(how, tarfile.REGTYPE)
        member.linkname = "/etc/passwd"
        if how == "more than there is":
            tar.fileobj.write(member.tobuf() + data)
        else:
            tar.addfile(member, io.BytesIO(data))
    with pytest.raises(ShardError, match=r"shard-00000\.tar: expected a tar of samples"):
        read_shard(path)


def test_what_is_being_written_is_no_shard(sample, stored, tmp_path):
    list(write_shards([sample], tmp_path / "samples"))
    list(write_shards([stored], tmp_path / "scenes"))
    for folder in ("samples", "scenes"):
        (tmp_path / folder / ".half-77-shard-00001.tar").write_bytes(b"half")
    scenes, whole = ShardScenes(tmp_path / "samples", "0", (Sample,)), StoredShards(tmp_path / "scenes", "0")
    assert [path.name for path in (*scenes.paths, *whole.paths)] == ["shard-00000.tar"] * 2
    assert len(scenes.scene(1)) == len(whole.scene(1)) == 1
