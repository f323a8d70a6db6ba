"""Runs scenes x methods, here, in processes or on a cluster, and goes on where an earlier run stopped."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace

import torch

from viewmend.evaluation.cells import Cell, CellKey, CellStore, cell_keys, method_identities, to_cells
from viewmend.evaluation.provenance import provenance
from viewmend.evaluation.ray_cluster import run_on_ray
from viewmend.evaluation.scene_run import MethodRun, RunSettings, SceneRun, evaluate_scene
from viewmend.evaluation.tasks import Task
from viewmend.leave_one_out.scenes import LeaveOneOutScene
from viewmend.terminal import log_to_terminal


def run_evaluation(
    scenes: Sequence[LeaveOneOutScene],
    methods: tuple[str, ...],
    store: CellStore,
    settings: RunSettings | None = None,
    jobs: int = 1,
    ray: str | None = None,
) -> Iterator[list[Cell]]:
    """The cells of one scene after another, as they are there: remembered ones first, the others once computed.

    Cells are remembered as soon as their scene is done; those that failed are tried again by the next run.

    Args:
        scenes: with different names.
        methods: names for `make_method`.
        store: where cells are remembered.
        settings: device, precision, hull and renderer.
        jobs: processes; 1 works in this one.
        ray: address of a Ray cluster that does the work instead (`ray_cluster`).

    Raises:
        ValueError: a method cannot be made, two scenes have one name, `jobs` is not positive, or there is no cluster.
    """
    settings = settings or RunSettings()
    _check([scene.name for scene in scenes], jobs)
    identities = method_identities(methods, settings)
    keys = {scene.name: cell_keys(scene, identities, settings) for scene in scenes}
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
    runs = _run(tasks, settings, jobs, threads)
    if ray is not None:
        origin = replace(origin, device=f"the Ray cluster {ray}", threads=1)
        runs = run_on_ray(tasks, settings, ray)
    for task, run in runs:
        cells = to_cells(task.scene, run, keys[task.scene.name], identities, origin)
        _remember(store, cells, run, keys[task.scene.name][0])
        yield [cell for cell, _ in cells]


def _check(names: list[str], jobs: int) -> None:
    if jobs < 1:
        raise ValueError(f"expected at least one job, got {jobs}")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"expected scenes of different names, got {', '.join(twice[:3])} twice; rename a folder")


def _remember(store: CellStore, cells: list[tuple[Cell, MethodRun]], run: SceneRun, key: CellKey) -> None:
    store.save_scene(key, run)
    for cell, one in cells:
        store.save(cell, one)


def _run(tasks: Sequence[Task], settings: RunSettings, jobs: int, threads: int) -> Iterator[tuple[Task, SceneRun]]:
    if jobs == 1:
        for task in tasks:
            yield task, evaluate_scene(task.scene, task.methods, settings)
        return
    left = list(tasks)
    try:
        with process_pool(jobs, threads) as pool:
            futures = {pool.submit(evaluate_scene, t.scene, t.methods, settings): t for t in tasks}
            try:
                for future in as_completed(futures):
                    yield futures[future], _result(future)
                    left.remove(futures[future])
            except BaseException:
                # What the workers have begun nobody will hear of: an interrupted run ends now.
                for worker in list((pool._processes or {}).values()):
                    worker.terminate()
                raise
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
    except BrokenProcessPool:
        # A process died (out of memory, say), and took the pool with it. One scene in a pool then finds the culprit.
        for task in left:
            yield task, _alone(task, settings, threads)


def _alone(task: Task, settings: RunSettings, threads: int) -> SceneRun:
    with process_pool(1, threads) as pool:
        try:
            return _result(pool.submit(evaluate_scene, task.scene, task.methods, settings))
        except BrokenProcessPool as error:
            said = f"the process died ({error}); is there enough memory?"
            return SceneRun(task.scene.name, tuple(MethodRun(name, (), said) for name in task.methods))


def _result(future: Future[SceneRun]) -> SceneRun:
    return future.result()


def process_pool(jobs: int, threads: int) -> ProcessPoolExecutor:
    """So many worker processes, each with so many threads, that end when this process does, however it does."""
    # Not forked: threads of torch and numba do not survive that.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(jobs, context, _begin, (threads,))


def _begin(threads: int) -> None:
    """What a worker does first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the parent says what it means
    log_to_terminal()
    torch.set_num_threads(threads)
    threading.Thread(target=_leave_with_parent, daemon=True).start()


def _leave_with_parent() -> None:
    """A worker whose parent was killed would wait for work forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
