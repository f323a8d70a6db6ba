"""Training runs, logs and cached results are read or rejected like any other file."""

import json
import struct
import zipfile
from dataclasses import asdict, replace

import numpy as np
import torch
from evaluation.conftest import ORIGIN
from fuzz.inputs import File, fuzz_file, join_tensors, mutated_bytes, mutated_json, split_tensors, to_json
from safetensors import safe_open
from safetensors.torch import save_file

from viewmend.evaluation.averages import records
from viewmend.evaluation.result_cache import Cell, CellKey, CellStore
from viewmend.evaluation.scores import KINDS, ViewScores
from viewmend.models.paper.config import paper_small
from viewmend.training.config import TrainConfig
from viewmend.training.paper import PaperObjectiveConfig
from viewmend.training.run_files import CHECKPOINT, Log, RunError, RunState, load_run, save_run


def test_runs(tmp_path):
    config = TrainConfig(name="a", objective=PaperObjectiveConfig(model=paper_small()), steps=1)
    module = torch.nn.Linear(2, 3)
    optimizer = torch.optim.AdamW(module.parameters())
    module(torch.ones(1, 2)).sum().backward()
    optimizer.step()
    parts = ({"model": module}, {"optimizer": optimizer})
    save_run(tmp_path, config, RunState(1, 2.0, ()), *parts)
    path = tmp_path / CHECKPOINT
    good = path.read_bytes()
    with safe_open(path, framework="pt") as file:
        metadata = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118

    def with_state(state):
        save_file(tensors, path, metadata | {"state": to_json(state).decode()})
        return File(path.read_bytes())

    header, rest = split_tensors(good)
    state = json.loads(metadata["state"]) | {"positions": [{"scene": 0, "sample": 1, "buffered": 2}]}
    inputs = mutated_json(state).map(with_state) | mutated_bytes(good).map(File)
    inputs |= mutated_json(header).map(lambda other: join_tensors(other, rest))
    fuzz_file(path, lambda: load_run(path, config, *parts), inputs, (RunError,))


def test_logs(tmp_path):
    file = tmp_path / "log.jsonl"
    file.write_bytes(b"".join(to_json({"step": step, "losses": {"total": 1.0}}) + b"\n" for step in range(4)))
    lines = [json.loads(line) for line in file.read_bytes().splitlines()]

    def read():
        with Log(tmp_path, 2, True):
            pass

    fuzz_file(file, read, mutated_json(lines).map(to_lines) | mutated_bytes(file.read_bytes()))


def to_lines(values: object) -> bytes:
    return (
        b"".join(to_json(value) + b"\n" for value in values) if isinstance(values, list) else to_json(values)
    )


def cell() -> Cell:
    names = ViewScores.__dataclass_fields__
    frame = ViewScores(
        **{n: 1 if n in ("time", "width_px", "height_px") or n.endswith("_px") else 0.5 for n in names}
    )
    return Cell(CellKey("s", "m", "d", "e"), "P", "ring", "calm", "x", (frame,), (1.0,), None, ORIGIN)


def test_features_with_a_truncated_header_are_ignored(tmp_path):
    store = CellStore(tmp_path)
    store.save(cell(), None)
    head = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1, 1024, \n"
    with zipfile.ZipFile(tmp_path / f"{cell().key.stem}.npz", "w") as packed:
        for kind in KINDS:
            packed.writestr(
                f"{kind}.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + bytes(4096)
            )
    assert store.load(cell().key).features is None


def test_cells(tmp_path):
    store = CellStore(tmp_path)
    features = {kind: np.zeros((1, 1024), np.float32) for kind in KINDS}
    store.save(replace(cell(), features=features), None)
    key = cell().key
    assert store.load(key) == cell() and store.load(key).features is not None

    def load_and_average():
        if (found := store.load(key)) is not None:
            records([found])
            json.dumps(asdict(found.key))

    fuzz_file(tmp_path / f"{key.stem}.json", load_and_average, refusals=())
    fuzz_file(tmp_path / f"{key.stem}.npz", lambda: store.load(key), refusals=())
