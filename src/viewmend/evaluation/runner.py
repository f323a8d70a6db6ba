"""Runs scenes x methods in this process, in several, or on a cluster, and resumes interrupted runs."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace

import torch

from viewmend.evaluation.provenance import provenance
from viewmend.evaluation.result_cache import (
    Cell,
    CellStore,
    cell_keys,
    method_identities,
    shared_model_identity,
    to_cells,
)
from viewmend.evaluation.scene_run import MethodRun, RunSettings, SceneRun, evaluate_scene
from viewmend.models.base import Inpainter
from viewmend.scenes.held_out import LeaveOneOutScene
from viewmend.utils.logging import log_to_terminal
from viewmend.utils.plugins import import_object

CLUSTER = "viewmend.contrib.ray.cluster:run_on_ray"
"""MODULE:NAME of the function that runs tasks on a Ray cluster; imported on demand."""


@dataclass(frozen=True)
class Task:
    """The methods that a scene lacks: one call of `evaluate_scene`."""

    scene: LeaveOneOutScene
    methods: tuple[str, ...]

    def failed(self, reason: str) -> SceneRun:
        """The result of a task whose process died."""
        return SceneRun(self.scene.name, tuple(MethodRun(name, error=reason) for name in self.methods))


def run_evaluation(
    scenes: Sequence[LeaveOneOutScene],
    methods: tuple[str, ...],
    store: CellStore,
    settings: RunSettings | None = None,
    jobs: int = 1,
    ray: str | None = None,
) -> Iterator[list[Cell]]:
    """The cells of one scene after another: stored ones first, then the others as they are computed.

    Cells are stored as soon as their scene is done. Failed cells are computed again by the next run.

    Args:
        scenes: with different names.
        methods: names for `make_method`.
        store: the folder of stored cells.
        settings: device, precision, hull and renderer.
        jobs: number of processes; 1 works in this one.
        ray: address of a Ray cluster that does the work instead.

    Raises:
        ValueError: a method cannot be made, two scenes have one name, `jobs` is not positive, or
            there is no cluster.
    """
    settings = settings or RunSettings()
    _check([scene.name for scene in scenes], jobs)
    identities = method_identities(methods, settings)
    shared_model = shared_model_identity(settings)
    keys = {scene.name: cell_keys(scene, identities, settings, shared_model) for scene in scenes}
    tasks = []
    for scene in scenes:
        cells = {key.method: store.load(key) for key in keys[scene.name]}
        known = [cell for cell in cells.values() if cell is not None and cell.error is None]
        missing = tuple(name for name in methods if name not in {cell.key.method for cell in known})
        if known:
            yield known
        if missing:
            tasks.append(Task(scene, missing))
    jobs = min(jobs, max(1, len(tasks)))
    threads = torch.get_num_threads() if jobs == 1 else max(1, (os.cpu_count() or 1) // jobs)
    origin = provenance(settings.device, threads, jobs)
    if ray is None:
        runs = _run(tasks, settings, jobs, threads)
    else:
        origin = replace(origin, device=f"the Ray cluster {ray}", threads=1)
        runs = import_object(CLUSTER)(tasks, settings, ray)
    for task, run in runs:
        cells = to_cells(task.scene, run, keys[task.scene.name], identities, origin)
        store.save_scene(keys[task.scene.name][0], run)
        for cell, one in zip(cells, run.runs, strict=True):
            store.save(cell, one.image)
        yield cells


def process_pool(jobs: int, threads: int) -> ProcessPoolExecutor:
    """A pool of `jobs` processes with `threads` threads each; they end with this process, even if it is killed."""
    # Not forked: threads of torch and numba do not survive that.
    return ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _start_worker, (threads,))


def _check(names: list[str], jobs: int) -> None:
    if jobs < 1:
        raise ValueError(f"expected at least one job, got {jobs}")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(
            f"expected scenes of different names, got {', '.join(twice[:3])} twice; rename a folder"
        )


def _run(
    tasks: Sequence[Task], settings: RunSettings, jobs: int, threads: int
) -> Iterator[tuple[Task, SceneRun]]:
    if jobs == 1:
        loaded: dict[str, Inpainter] = {}
        for task in tasks:
            yield task, evaluate_scene(task.scene, task.methods, settings, loaded)
        return
    left = list(tasks)
    try:
        with process_pool(jobs, threads) as pool:
            futures = {pool.submit(evaluate_scene, t.scene, t.methods, settings): t for t in tasks}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
                    left.remove(futures[future])
            except BaseException:
                # The run was interrupted: end at once, without waiting for the tasks in progress.
                for worker in list((pool._processes or {}).values()):
                    worker.terminate()
                raise
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
    except BrokenProcessPool:
        # A process died (out of memory, say) and broke the pool. Run the rest one by one: only the
        # culprit fails.
        for task in left:
            yield task, _run_alone(task, settings, threads)


def _run_alone(task: Task, settings: RunSettings, threads: int) -> SceneRun:
    with process_pool(1, threads) as pool:
        try:
            return pool.submit(evaluate_scene, task.scene, task.methods, settings).result()
        except BrokenProcessPool as error:
            return task.failed(f"the process died ({error}); is there enough memory?")


def _start_worker(threads: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the parent handles it
    log_to_terminal()
    torch.set_num_threads(threads)
    threading.Thread(target=_exit_with_parent, daemon=True).start()


def _exit_with_parent() -> None:
    """End a worker whose parent was killed; it would wait for work forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
