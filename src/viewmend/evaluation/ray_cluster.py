"""Scenes on a Ray cluster: the same function of the same arguments as here, so the same numbers."""

import socket
from collections.abc import Iterator, Sequence
from typing import Any

from viewmend.evaluation.scene_run import MethodRun, RunSettings, SceneRun, evaluate_scene
from viewmend.evaluation.tasks import Task
from viewmend.leave_one_out.scenes import LeaveOneOutScene

ANSWER_S = 5.0
"""A cluster answers within this time."""
LOCAL = "local"
"""Instead of an address: a cluster of this machine alone, for as long as the run lasts."""


def run_on_ray(tasks: Sequence[Task], settings: RunSettings, address: str) -> Iterator[tuple[Task, SceneRun]]:
    """The runs of all tasks, in the order in which they are done, one task on one core, or on one GPU.

    Machines of the cluster need this package, and captures, people and models under the same paths. A task whose
    process dies fails alone.

    Args:
        tasks: what to run.
        settings: how.
        address: of a running cluster (HOST:PORT, ray://HOST:PORT, auto), or `LOCAL`.

    Raises:
        ValueError: Ray is not installed, or there is no cluster at the address.
    """
    if not tasks:
        return
    ray = _ray()
    started = not ray.is_initialized()
    if started:
        _connect(ray, address)
    try:
        cost = {"num_cpus": 1, "num_gpus": 1 if settings.device.startswith("cuda") else 0, "max_retries": 0}
        evaluate = ray.remote(**cost)(_on_one_core)
        waiting = {evaluate.remote(task.scene, task.methods, settings): task for task in tasks}
        while waiting:
            (done, *_), _ = ray.wait(list(waiting))
            task = waiting.pop(done)
            try:
                yield task, ray.get(done)
            except ray.exceptions.RayError as error:
                said = (
                    f"its process on the cluster died ({' '.join(str(error).split())[:200]}); is there enough memory?"
                )
                yield task, SceneRun(task.scene.name, tuple(MethodRun(name, (), said) for name in task.methods))
    finally:
        if started:
            ray.shutdown()


def _on_one_core(scene: LeaveOneOutScene, methods: tuple[str, ...], settings: RunSettings) -> SceneRun:
    import torch

    torch.set_num_threads(1)
    return evaluate_scene(scene, methods, settings)


def _knock(address: str) -> None:
    """OSError where nobody listens at HOST:PORT; Ray itself would wait for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdecimal():
        socket.create_connection((host, int(port)), timeout=ANSWER_S).close()


def _ray() -> Any:
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ValueError(
            "expected Ray for --ray, got none; install viewmend's extra 'ray', or leave --ray away"
        ) from error
    return ray


def _connect(ray: Any, address: str) -> None:
    try:
        _knock(address)
        ray.init(None if address == LOCAL else address, include_dashboard=False, log_to_driver=False)
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"expected a Ray cluster at '{address}', got none ({' '.join(str(error).split())[:200]}); check --ray, or "
            f"use --ray {LOCAL}"
        ) from error
