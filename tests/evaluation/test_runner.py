"""Runs of several scenes: resumable, the same in processes as serially, and robust against failures."""

import json
import os
import pickle
import select
import shutil
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from viewmend.contrib.ray import cluster
from viewmend.evaluation import scene_run
from viewmend.evaluation.result_cache import CellStore, cell_keys
from viewmend.evaluation.runner import run_evaluation
from viewmend.evaluation.scene_run import MethodRun, RunSettings, SceneRun
from viewmend.evaluation.scores import Scorers
from viewmend.metrics.weights import FOLDERS_VARIABLE
from viewmend.models.classical import Telea
from viewmend.rendering.view import RenderConfig
from viewmend.stream import StreamConfig
from viewmend.types import CompletedView
from viewmend.utils.weight_files import MissingWeightsError

METHODS = ("telea", "unfilled")
SCRIPT = (
    "import pickle, sys, pathlib; from viewmend.evaluation.result_cache import CellStore; "
    "from viewmend.evaluation.runner import run_evaluation; scenes = pickle.loads(pathlib.Path(sys.argv[1])"
    f".read_bytes())\nfor cells in run_evaluation(scenes, {METHODS}, CellStore(pathlib.Path(sys.argv[2])), "
    "ray=sys.argv[3] or None): print(len(cells), flush=True)"
)


def run(scenes, folder, methods=METHODS, **how):
    cells = [cell for found in run_evaluation(scenes, methods, CellStore(folder), **how) for cell in found]
    return {(cell.key.scene, cell.key.method): cell for cell in cells}


def scores(cells):
    return {key: cell.frames for key, cell in cells.items()}


@pytest.fixture(scope="module")
def whole(small_scenes, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(small_scenes, folder)


def test_every_scene_has_every_method(whole, small_scenes):
    _, cells = whole
    assert set(cells) == {(s.name, m) for s in small_scenes for m in METHODS}
    assert all(cell.error is None and len(cell.frames) == len(cell.step_ms) == 2 for cell in cells.values())
    assert all(f.hole_px > 50 for cell in cells.values() for f in cell.frames)
    telea, unfilled = (cells["s1", m].frames[0] for m in METHODS)
    assert telea.psnr_holes > unfilled.psnr_holes
    assert (telea.hole_px, telea.hull_px) == (unfilled.hole_px, unfilled.hull_px)


@pytest.mark.slow
def test_processes_compute_the_same_numbers(whole, small_scenes, tmp_path):
    assert scores(run(small_scenes, tmp_path, jobs=2)) == scores(whole[1])


def test_stored_cells_are_not_computed_again(whole, small_scenes, monkeypatch):
    folder, cells = whole
    monkeypatch.setattr("viewmend.evaluation.runner.evaluate_scene", None)
    assert run(small_scenes, folder) == cells


def script(small_scenes, tmp_path, ray=""):
    (tmp_path / "scenes").write_bytes(pickle.dumps(small_scenes))
    return [sys.executable, "-c", SCRIPT, str(tmp_path / "scenes"), str(tmp_path / "cells"), ray]


@pytest.mark.slow
def test_a_killed_run_resumes(whole, small_scenes, tmp_path):
    with subprocess.Popen(script(small_scenes, tmp_path), stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert int(process.stdout.readline()) == len(METHODS), "the first scene is stored"
        process.kill()
    cells = tmp_path / "cells"
    before = {path: path.stat().st_mtime_ns for path in cells.glob("[!.]*.json")}
    assert len(before) >= len(METHODS)
    assert scores(run(small_scenes, cells)) == scores(whole[1])
    assert all(path.stat().st_mtime_ns == at for path, at in before.items())


@pytest.fixture
def copied(whole, tmp_path):
    return Path(shutil.copytree(whole[0], tmp_path / "copied"))


def test_a_damaged_cell_is_computed_again(whole, small_scenes, copied):
    path = next(p for p in copied.glob("s1*.json") if "telea" in p.name)
    other = json.loads(path.read_text())
    other["frames"][0].pop("psnr_whole")
    store, key = CellStore(copied), whole[1]["s1", "telea"].key
    assert store.load(key) == whole[1]["s1", "telea"]
    for damage in ("", '{"key": ', "[]", '{"key": {}}', json.dumps(other)):
        path.write_text(damage)
        assert store.load(key) is None
    assert scores(run(small_scenes, copied)) == scores(whole[1])
    assert (
        json.loads(path.read_text())["frames"][0]["psnr_whole"]
        == whole[1]["s1", "telea"].frames[0].psnr_whole
    )


def test_damaged_images_are_ignored(whole, copied):
    store, keys = CellStore(copied), [cell.key for cell in whole[1].values()]
    assert all(store.image(key) is not None and store.scene_images(key) is not None for key in keys)
    for path in copied.glob("*.png"):
        path.write_bytes(path.read_bytes()[:100])
    assert all(store.image(key) is None and store.scene_images(key) is None for key in keys)


class FailsLater(Telea):
    def step(self, view, context, state):
        if view.time:
            raise RuntimeError("no\nmore")
        return super().step(view, context, state)


class ChangesEverything(Telea):
    def step(self, view, context, state):
        completed, state = super().step(view, context, state)
        return replace(completed, rgb=completed.rgb + 0.1), state


@contextmanager
def in_place_of_telea(inpainter):
    make = scene_run.make_method
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            scene_run, "make_method", lambda name, *how: inpainter() if name == "telea" else make(name, *how)
        )
        yield


@pytest.mark.parametrize(
    ("inpainter", "message"), [(FailsLater, "no more"), (ChangesEverything, "pixels with E = 0")]
)
def test_a_failed_cell_is_reported_and_tried_again(small_scenes, tmp_path, whole, inpainter, message):
    with in_place_of_telea(inpainter):
        cells = run(small_scenes[:1], tmp_path)
    assert message in cells["s1", "telea"].error and cells["s1", "telea"].frames == ()
    assert cells["s1", "unfilled"].error is None
    again = run(small_scenes[:1], tmp_path)
    assert scores(again) == {key: f for key, f in scores(whole[1]).items() if key[0] == "s1"}


class Blackens(Telea):
    error_rule = "all"

    def step(self, view, context, state):
        return CompletedView(view, (1 - view.error) * view.rgb), state


@pytest.mark.parametrize("rule", [None, "holes"])
def test_each_method_has_its_own_error_rule(small_scenes, tmp_path, whole, rule):
    settings = RunSettings(stream=StreamConfig(render=RenderConfig(error_rule=rule), memory_mb=None))
    with in_place_of_telea(Blackens):
        cells = run(small_scenes[:1], tmp_path, settings=settings)
    black, unfilled = (cells["s1", name].frames[0] for name in METHODS)
    assert unfilled.psnr_whole == whole[1]["s1", "unfilled"].frames[0].psnr_whole
    assert (black.psnr_whole < unfilled.psnr_whole) == (rule is None), "its own rule includes coloured pixels"
    assert (black.hole_px, black.psnr_whole_rendered) == (unfilled.hole_px, unfilled.psnr_whole_rendered)


@pytest.mark.skipif(not hasattr(os, "pidfd_open"), reason="needs pidfd_open")
def test_workers_exit_when_their_parent_is_killed():
    script = (
        "import os; from viewmend.evaluation.runner import process_pool; pool = process_pool(1, 1); "
        "print(pool.submit(os.getpid).result(), flush=True); input()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as parent:
        assert parent.stdout is not None
        worker = os.pidfd_open(int(parent.stdout.readline()))
        parent.kill()
    assert select.select([worker], [], [], 30)[0], "the worker is still running"
    os.close(worker)


def test_a_scene_that_fails_fails_for_every_method(small_scenes, tmp_path):
    cells = run([replace(small_scenes[0], held="cam99")], tmp_path)
    assert all("cam99" in cell.error for cell in cells.values()) and len(cells) == len(METHODS)


def test_attributes_that_refer_to_each_other_are_one_clear_error(small_scenes, tmp_path):
    path = tmp_path / "own.py"
    path.write_text(
        "from viewmend.models.classical import Telea\nclass Own(Telea):\n"
        "    def __init__(self):\n        self.again = [self]\n"
    )
    with pytest.raises(ValueError, match=r"own\.py:Own: expected attributes that identify the method"):
        run(small_scenes, tmp_path / "cells", (f"{path}:Own",))


def test_scenes_of_one_name_and_unknown_methods_are_refused(small_scenes, tmp_path):
    with pytest.raises(ValueError, match="different names"):
        run([small_scenes[0]] * 2, tmp_path)
    with pytest.raises(ValueError, match="no-such-method"):
        run(small_scenes, tmp_path, ("no-such-method",))


def test_other_settings_are_other_cells(small_scenes):
    usual = cell_keys(small_scenes[0], {"telea": "x"}, RunSettings())
    for other in (
        {"ssim": "uniform7"},
        {"precision": "bfloat16"},
        {"background": "white"},
        {"protocol": "target-mask"},
        {"top_k": 64},
    ):
        assert cell_keys(small_scenes[0], {"telea": "x"}, RunSettings(**other)) != usual
    assert cell_keys(small_scenes[0], {"telea": "y"}, RunSettings()) != usual
    assert cell_keys(replace(small_scenes[0], held="cam03"), {"telea": "x"}, RunSettings()) != usual


@pytest.mark.parametrize(
    "settings",
    [
        RunSettings(stream=StreamConfig(geometry="fused")),
        RunSettings(protocol="predicted-mask"),
        RunSettings(stream=StreamConfig(render=RenderConfig(error_rule="predicted"))),
    ],
)
def test_another_model_that_predicts_depth_masks_or_errors_makes_other_cells(
    settings, small_scenes, tmp_path, monkeypatch
):
    """Views of all methods depend on it, so cells of an earlier version of its weights are not used."""
    done = SceneRun(small_scenes[0].name, (MethodRun("unfilled"),))
    monkeypatch.setattr("viewmend.evaluation.runner.evaluate_scene", lambda *_: done)
    keys = []
    for weight in (1, 1, 2):
        model = SimpleNamespace(weight=weight)
        monkeypatch.setattr("viewmend.evaluation.result_cache.error_model_for", lambda *_, model=model: model)
        (cell,) = run(small_scenes[:1], tmp_path, ("unfilled",), settings=settings).values()
        keys.append(cell.key)
    assert keys[0] == keys[1] != keys[2]


def test_an_edited_error_rule_makes_other_cells(small_scenes, tmp_path):
    file = tmp_path / "own.py"
    keys = []
    for number in (1, 11):
        file.write_text(f"def rule(evidence):\n    return {number}\n")
        settings = RunSettings(stream=StreamConfig(render=RenderConfig(error_rule=f"{file}:rule")))
        keys.append([cell_keys(small_scenes[0], {"telea": "x"}, settings) for _ in range(2)])
    assert keys[0][0] == keys[0][1] != keys[1][0]


@pytest.mark.slow
@pytest.mark.usefixtures("with_ray")
def test_a_ray_cluster_computes_the_same_numbers(whole, small_scenes, tmp_path):
    # In a separate process: Ray leaves sockets and threads behind, which the test session reports as errors.
    subprocess.run(script(small_scenes, tmp_path, "local"), check=True, capture_output=True)
    assert len(list((tmp_path / "cells").glob("*.json"))) == len(METHODS) * len(small_scenes)
    assert scores(run(small_scenes, tmp_path / "cells")) == scores(whole[1])


class RayError(Exception):
    """As Ray's."""


class RayTaskError(RayError):
    """As Ray's: a task raised an exception."""

    def __init__(self, cause):
        super().__init__("a long traceback")
        self.cause = cause


class ClusterOfThisProcess:
    """Stands for Ray; tasks run when they are waited for, as if in a process that was started elsewhere."""

    exceptions = SimpleNamespace(RayError=RayError, RayTaskError=RayTaskError)

    def __init__(self, folder, monkeypatch):
        self.folder = folder
        self.monkeypatch = monkeypatch

    def is_initialized(self):
        return True

    def remote(self, **cost):
        return lambda work: SimpleNamespace(remote=partial(partial, work))

    def wait(self, futures):
        return futures[:1], futures[1:]

    def get(self, future):
        with self.monkeypatch.context() as elsewhere:
            elsewhere.chdir(self.folder)
            elsewhere.delenv(FOLDERS_VARIABLE, raising=False)
            try:
                return future()
            except MemoryError as error:
                raise RayError("died") from error
            except Exception as error:
                raise RayTaskError(error) from error


def test_tasks_on_a_cluster_have_the_commands_folder_and_weights_and_say_what_they_raised(
    small_scenes, tmp_path, monkeypatch
):
    seen = []
    outcomes = iter((None, MissingWeightsError("no\nweights"), MemoryError()))

    def evaluate(scene, methods, settings):
        seen.append((Path.cwd(), os.environ[FOLDERS_VARIABLE]))
        outcome = next(outcomes)
        if outcome is not None:
            raise outcome
        return SceneRun(scene.name, tuple(MethodRun(name) for name in methods))

    monkeypatch.setattr(cluster, "evaluate_scene", evaluate)
    (tmp_path / "elsewhere").mkdir()
    ray = ClusterOfThisProcess(tmp_path / "elsewhere", monkeypatch)
    monkeypatch.setattr(cluster, "find_ray", lambda address: ray)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(FOLDERS_VARIABLE, "own-weights")
    cells = run(small_scenes, tmp_path / "cells", ("unfilled",), ray="host:1")
    assert seen == [(tmp_path, "own-weights")] * 3
    done, raised, died = (cell.error for cell in cells.values())
    assert done is None and raised == "MissingWeightsError: no weights"
    assert "its process on the cluster died (died); is there enough memory?" in died


def test_a_missing_cluster_is_one_clear_error(small_scenes, tmp_path, monkeypatch):
    ray = SimpleNamespace(is_initialized=lambda: False)
    monkeypatch.setattr(cluster, "find_ray", lambda address: ray)
    with pytest.raises(ValueError, match=r"expected a Ray cluster at '127.0.0.1:1', got none .* --ray local"):
        run(small_scenes[:1], tmp_path, ray="127.0.0.1:1")


def test_the_model_that_predicts_errors_has_the_runs_precision(monkeypatch):
    asked = []
    monkeypatch.setattr(scene_run, "error_model_for", lambda *arguments: asked.append(arguments[1:]))
    stream = StreamConfig(render=RenderConfig(error_rule="predicted"), memory_mb=None)
    settings = RunSettings(precision="float32", stream=stream)
    scene_run._MethodStream("telea", settings, Scorers(), {})._make(None)
    assert asked == [("cpu", "float32")]
