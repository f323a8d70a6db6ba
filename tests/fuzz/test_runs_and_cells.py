"""Runs, logs and cells of strangers are read or refused like any other file: in one line, soon, in little memory."""

import json
import struct
import zipfile
from dataclasses import asdict

import numpy as np
import torch
from evaluation.conftest import ORIGIN
from fuzz.inputs import FUZZED, File, changed, held, joined, parts_of, spoilt, text_of
from hypothesis import given
from safetensors import safe_open
from safetensors.torch import save_file

from viewmend.evaluation import scorers
from viewmend.evaluation.cells import Cell, CellKey, CellStore
from viewmend.evaluation.frame_scores import FrameScores
from viewmend.evaluation.records import records
from viewmend.evaluation.scene_run import MethodRun
from viewmend.inpainting.config import small
from viewmend.training.logs import Log
from viewmend.training.plan import Recipe
from viewmend.training.run_files import FILE, RunError, RunState, load_run, save_run


def test_runs(tmp_path):
    recipe = Recipe(name="a", model=small(), steps=1)
    module = torch.nn.Linear(2, 3)
    optimizer = torch.optim.AdamW(module.parameters())
    module(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    parts = ({"model": module}, {"optimizer": optimizer})
    save_run(tmp_path, recipe, RunState(1, 2.0, ()), *parts)
    path = tmp_path / FILE
    good = path.read_bytes()
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118

    def told(state):
        save_file(tensors, path, metadata | {"state": text_of(state).decode()})
        return File(path.read_bytes())

    head, rest = parts_of(good)
    state = json.loads(metadata["state"]) | {"positions": [{"scene": 0, "sample": 1, "buffered": 2}]}

    @FUZZED
    @given(changed(state).map(told) | changed(head).map(lambda other: joined(other, rest)) | spoilt(good).map(File))
    def fuzz(data):
        path.write_bytes(data)
        held(lambda: load_run(path, recipe, *parts), (RunError,))

    fuzz()


def test_logs(tmp_path):
    file = tmp_path / "log.jsonl"
    good = b"".join(text_of({"step": step, "losses": {"total": 1.0}}) + b"\n" for step in range(4))

    def read():
        with Log(tmp_path, 2, True):
            pass

    @FUZZED
    @given(changed([json.loads(line) for line in good.splitlines()]).map(lines_of) | spoilt(good))
    def fuzz(data):
        file.write_bytes(data)
        held(read)

    fuzz()


def lines_of(values: object) -> bytes:
    return b"".join(text_of(value) + b"\n" for value in values) if isinstance(values, list) else text_of(values)


def cell() -> Cell:
    names = FrameScores.__dataclass_fields__
    frame = FrameScores(**{n: 1 if n in ("time", "width_px", "height_px") or n.endswith("_px") else 0.5 for n in names})
    return Cell(CellKey("s", "m", "d", "e"), "P", "ring", "calm", "x", (frame,), None, ORIGIN)


def test_features_whose_head_is_not_closed_are_damaged(tmp_path):
    store = CellStore(tmp_path)
    store.save(cell(), MethodRun("m", cell().frames, None))
    head = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1, 1024, \n"
    with zipfile.ZipFile(tmp_path / f"{cell().key.stem}.npz", "w") as packed:
        for kind in scorers.KINDS:
            packed.writestr(f"{kind}.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(4096))
    assert store.load(cell().key).features is None


def test_cells(tmp_path):
    store = CellStore(tmp_path)
    features = {kind: np.zeros((1, 1024), np.float32) for kind in scorers.KINDS}
    store.save(cell(), MethodRun("m", cell().frames, None, features=features))
    key = cell().key
    file, arrays = (tmp_path / f"{key.stem}.{suffix}" for suffix in ("json", "npz"))
    good, packed = file.read_bytes(), arrays.read_bytes()
    assert store.load(key) == cell() and store.load(key).features is not None

    @FUZZED
    @given(changed(json.loads(good)).map(text_of) | spoilt(good))
    def fuzz(data):
        file.write_bytes(data)
        held(lambda: demand_usual(store.load(key)), ())

    @FUZZED
    @given(spoilt(packed))
    def fuzz_features(data):
        arrays.write_bytes(data)
        held(lambda: store.load(key), ())

    fuzz()
    file.write_bytes(good)
    fuzz_features()


def demand_usual(found: Cell | None) -> None:
    """A cell that is there can be averaged."""
    if found is not None:
        records([found])
        json.dumps(asdict(found.key))
