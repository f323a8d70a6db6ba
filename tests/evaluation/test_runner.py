"""Resumable, in processes as serially, and failures are shown."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from viewmend.baselines.classical import Telea
from viewmend.evaluation import ray_cluster, scene_run
from viewmend.evaluation.cells import CellStore
from viewmend.evaluation.runner import run_evaluation
from viewmend.evaluation.scene_run import RunSettings
from viewmend.rendering.view import RenderConfig
from viewmend.stream import StreamConfig
from viewmend.views import CompletedView

METHODS = ("telea", "unfilled")


def run(scenes, folder, methods=METHODS, **how):
    cells = [cell for found in run_evaluation(scenes, methods, CellStore(folder), **how) for cell in found]
    return {(cell.key.scene, cell.key.method): cell for cell in cells}


def figures(cells):
    """All that does not depend on the clock."""
    return {at: [replace(frame, step_ms=0.0) for frame in cell.frames] for at, cell in cells.items()}


@pytest.fixture(scope="module")
def whole(small_scenes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(small_scenes, folder)


def test_every_scene_has_every_method_and_they_differ(whole, small_scenes):
    _, cells = whole
    assert set(cells) == {(s.name, m) for s in small_scenes for m in METHODS}
    assert all(cell.error is None and len(cell.frames) == 2 for cell in cells.values())
    assert all(f.hole_px > 50 for cell in cells.values() for f in cell.frames)
    telea, unfilled = (cells["s1", m].frames[0] for m in METHODS)
    assert telea.psnr_holes > unfilled.psnr_holes
    assert (telea.hole_px, telea.hull_px) == (unfilled.hole_px, unfilled.hull_px)


def test_processes_compute_the_same_numbers(whole, small_scenes, tmp_path):
    assert figures(run(small_scenes, tmp_path, jobs=2)) == figures(whole[1])


def test_a_run_that_was_there_is_not_computed_again(whole, small_scenes, monkeypatch):
    folder, cells = whole
    monkeypatch.setattr("viewmend.evaluation.runner.evaluate_scene", None)
    assert run(small_scenes, folder) == cells


def test_a_killed_run_goes_on_where_it_was(whole, small_scenes, tmp_path):
    scenes = tmp_path / "scenes"
    scenes.write_bytes(pickle.dumps(small_scenes))
    cells = tmp_path / "cells"
    script = (
        "import pickle, sys, pathlib; from viewmend.evaluation.cells import CellStore; "
        "from viewmend.evaluation.runner import run_evaluation; scenes = pickle.loads(pathlib.Path(sys.argv[1])"
        f".read_bytes()); print(*run_evaluation(scenes, {METHODS}, CellStore(pathlib.Path(sys.argv[2]))))"
    )
    process = subprocess.Popen([sys.executable, "-c", script, str(scenes), str(cells)], stdout=subprocess.DEVNULL)
    while process.poll() is None and len(list(cells.glob("[!.]*.json"))) < len(METHODS):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = {path: path.stat().st_mtime_ns for path in cells.glob("[!.]*.json")}
    assert len(before) >= len(METHODS)
    assert figures(run(small_scenes, cells)) == figures(whole[1])
    assert all(path.stat().st_mtime_ns == at for path, at in before.items())


@pytest.fixture
def copied(whole, tmp_path):
    """The cells of the whole run, to be harmed."""
    return Path(shutil.copytree(whole[0], tmp_path / "copied"))


def test_a_damaged_cell_is_computed_again(whole, small_scenes, copied):
    path = next(p for p in copied.glob("s1*.json") if "telea" in p.name)
    other = json.loads(path.read_text())
    other["frames"][0].pop("psnr_holes")
    store, key = CellStore(copied), whole[1]["s1", "telea"].key
    assert store.load(key) == whole[1]["s1", "telea"]
    for damage in ("", '{"key": ', "[]", '{"key": {}}', json.dumps(other)):
        path.write_text(damage)
        assert store.load(key) is None
    assert figures(run(small_scenes, copied)) == figures(whole[1])
    assert json.loads(path.read_text())["frames"][0]["psnr_holes"] == whole[1]["s1", "telea"].frames[0].psnr_holes


def test_damaged_pictures_do_not_matter(whole, copied):
    store, keys = CellStore(copied), [cell.key for cell in whole[1].values()]
    assert all(store.picture(key) is not None and store.pictures(key) is not None for key in keys)
    for path in copied.glob("*.png"):
        path.write_bytes(path.read_bytes()[:100])
    assert all(store.picture(key) is None and store.pictures(key) is None for key in keys)


class FailsLater(Telea):
    def step(self, view, context, state):
        if view.time:
            raise RuntimeError("no\nmore")
        return super().step(view, context, state)


class Paints(Telea):
    def step(self, view, context, state):
        completed, state = super().step(view, context, state)
        return replace(completed, rgb=completed.rgb + 0.1), state


@pytest.mark.parametrize(("inpainter", "said"), [(FailsLater, "no more"), (Paints, "pixels with E = 0")])
def test_a_cell_that_fails_is_shown_tried_again_and_harms_no_other(
    small_scenes, tmp_path, monkeypatch, whole, inpainter, said
):
    honest = scene_run.make_method
    broken = lambda name, *how: inpainter() if name == "telea" else honest(name, *how)  # noqa: E731
    with monkeypatch.context() as patch:
        patch.setattr(scene_run, "make_method", broken)
        cells = run(small_scenes[:1], tmp_path)
    assert said in cells["s1", "telea"].error and cells["s1", "telea"].frames == ()
    assert cells["s1", "unfilled"].error is None
    again = run(small_scenes[:1], tmp_path)
    assert figures(again) == {at: f for at, f in figures(whole[1]).items() if at[0] == "s1"}


class Repaints(Telea):
    error_rule = "all"

    def step(self, view, context, state):
        return CompletedView(view, (1 - view.error) * view.rgb), state


@pytest.mark.parametrize("rule", [None, "unseen"])
def test_each_method_is_asked_for_what_it_is_made_for(small_scenes, tmp_path, monkeypatch, whole, rule):
    honest = scene_run.make_method
    own = lambda name, *how: Repaints() if name == "telea" else honest(name, *how)  # noqa: E731
    monkeypatch.setattr(scene_run, "make_method", own)
    settings = RunSettings(stream=StreamConfig(render=RenderConfig(error_rule=rule), memory_mb=None))
    cells = run(small_scenes[:1], tmp_path, settings=settings)
    black, unfilled = (cells["s1", name].frames[0] for name in METHODS)
    assert unfilled.psnr_whole == whole[1]["s1", "unfilled"].frames[0].psnr_whole
    assert (black.psnr_whole < unfilled.psnr_whole) == (rule is None), "its own rule asks for what is coloured, too"
    assert (black.hole_px, black.psnr_whole_rendered) == (unfilled.hole_px, unfilled.psnr_whole_rendered)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_workers_leave_when_their_parent_is_killed():
    script = (
        "import os, time; from viewmend.evaluation.runner import process_pool; pool = process_pool(1, 1); "
        "print(pool.submit(os.getpid).result(), flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        worker = int(parent.stdout.readline())
        parent.kill()
    end = time.monotonic() + 30
    while runs(worker) and time.monotonic() < end:
        time.sleep(0.05)
    if runs(worker):
        os.kill(worker, signal.SIGKILL)
        pytest.fail("it waits for work that nobody will give it")


def runs(process):
    """Whether it is there and no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_scene_that_fails_is_shown_for_every_method(small_scenes, tmp_path):
    cells = run([replace(small_scenes[0], held="cam99")], tmp_path)
    assert all("cam99" in cell.error for cell in cells.values()) and len(cells) == len(METHODS)


def test_scenes_of_one_name_and_unknown_methods_are_refused(small_scenes, tmp_path):
    with pytest.raises(ValueError, match="different names"):
        run([small_scenes[0]] * 2, tmp_path)
    with pytest.raises(ValueError, match="no-such-method"):
        run(small_scenes, tmp_path, ("no-such-method",))


def test_other_rules_are_other_cells(small_scenes, tmp_path):
    from viewmend.evaluation.cells import cell_keys

    usual = cell_keys(small_scenes[0], {"telea": "x"}, RunSettings())
    for other in (RunSettings(ssim="uniform7"), RunSettings(precision="bfloat16")):
        assert cell_keys(small_scenes[0], {"telea": "x"}, other) != usual
    assert cell_keys(small_scenes[0], {"telea": "y"}, RunSettings()) != usual
    assert cell_keys(replace(small_scenes[0], held="cam03"), {"telea": "x"}, RunSettings()) != usual


def test_a_rule_of_ones_own_that_was_edited_is_another_cell(small_scenes, tmp_path, monkeypatch):
    from viewmend.evaluation.cells import cell_keys

    file, read = tmp_path / "own.py", []
    settings = RunSettings(stream=StreamConfig(render=RenderConfig(error_rule=f"{write_rule(file, 1)}:rule")))
    before = cell_keys(small_scenes[0], {"telea": "x"}, settings)
    as_ever = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: (read.append(path), as_ever(path))[1])
    assert cell_keys(small_scenes[0], {"telea": "x"}, settings) == before and read == [], "it is not read for each view"
    write_rule(file, 11)
    assert cell_keys(small_scenes[0], {"telea": "x"}, settings) != before and read == [file]


def write_rule(file, number):
    file.write_text(f"def rule(evidence):\n    return {number}\n")
    return file


@pytest.mark.slow
def test_a_ray_cluster_computes_the_same_numbers(whole, small_scenes, tmp_path):
    pytest.importorskip("ray", reason="Ray is not installed")
    script = (
        "import pickle, sys, pathlib; from viewmend.evaluation.cells import CellStore; "
        "from viewmend.evaluation.runner import run_evaluation; scenes = pickle.loads(pathlib.Path(sys.argv[1])"
        f".read_bytes()); print(*run_evaluation(scenes, {METHODS}, CellStore(pathlib.Path(sys.argv[2])), ray='local'))"
    )
    (tmp_path / "scenes").write_bytes(pickle.dumps(small_scenes))
    # In a process of its own: Ray leaves sockets and threads behind, which count as mistakes here.
    command = [sys.executable, "-c", script, str(tmp_path / "scenes"), str(tmp_path / "cells")]
    subprocess.run(command, check=True, capture_output=True)
    assert len(list((tmp_path / "cells").glob("*.json"))) == len(METHODS) * len(small_scenes)
    assert figures(run(small_scenes, tmp_path / "cells")) == figures(whole[1])


def test_a_cluster_that_is_not_there_is_one_clear_error(small_scenes, tmp_path, monkeypatch):
    ray = SimpleNamespace(is_initialized=lambda: False)
    monkeypatch.setattr(ray_cluster, "find_ray", lambda address: ray)
    with pytest.raises(ValueError, match=r"expected a Ray cluster at '127.0.0.1:1', got none .* --ray local"):
        run(small_scenes[:1], tmp_path, ray="127.0.0.1:1")
