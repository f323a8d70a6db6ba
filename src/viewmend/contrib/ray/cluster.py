"""Ray, an extra: connecting to a cluster, and evaluation on it with the same function and arguments as locally."""

import os
import secrets
import socket
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from viewmend.evaluation.runner import Task
from viewmend.evaluation.scene_run import RunSettings, SceneRun, evaluate_scene
from viewmend.metrics.weights import FOLDERS_VARIABLE

ANSWER_S = 5.0
"""A cluster has to answer within this many seconds."""
LOCAL = "local"
"""Instead of an address: a cluster of this machine alone, for as long as the run lasts."""
QUIET = {"RAY_USAGE_STATS_ENABLED": "0"}
"""Disables usage reports."""
ON_LOOPBACK = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
"""Binds a cluster's sockets to 127.0.0.1."""
AS_URGENT = {"RAY_worker_niceness": "0"}
"""Gives work the priority of the command that started it; Ray's default is the lowest."""


def find_ray(address: str) -> Any:
    """Import ray with usage reports disabled and a local cluster bound to loopback.

    A local cluster requires a random token.

    Raises:
        ValueError: Ray is not installed.
    """
    wanted = QUIET
    if address == LOCAL:
        wanted = (
            wanted
            | ON_LOOPBACK
            | AS_URGENT
            | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
        )
    for name, value in wanted.items():
        os.environ.setdefault(name, value)
    try:
        import ray
    except ImportError as error:
        raise ValueError(
            "expected Ray for --ray, got none; install viewmend's extra 'ray', or omit --ray"
        ) from error
    return ray


def connect(ray: Any, address: str, **own: object) -> None:
    """Connect to a running cluster, or start one of this machine alone.

    Raises:
        ValueError: there is no cluster at the address.
    """
    local = address == LOCAL
    try:
        host, colon, port = address.removeprefix("ray://").rpartition(":")
        if colon and port.isdecimal():  # Ray itself would wait for minutes
            socket.create_connection((host, int(port)), timeout=ANSWER_S).close()
        quiet = {"include_dashboard": False, "log_to_driver": False, "configure_logging": False}
        ray.init(None if local else address, **quiet, **(own if local else {}))
    except (OSError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"expected a Ray cluster at '{address}', got none ({' '.join(str(error).split())[:200]}); check --ray, or "
            f"use --ray {LOCAL}"
        ) from error


def run_on_ray(tasks: Sequence[Task], settings: RunSettings, address: str) -> Iterator[tuple[Task, SceneRun]]:
    """The results of all tasks as they finish; each task runs on one core, or on one GPU.

    Machines of the cluster need this package, and captures, people, models and weights at the same
    paths. A task that raises, or whose process dies, fails alone.

    Raises:
        ValueError: Ray is not installed, or there is no cluster at the address.
    """
    if not tasks:
        return
    ray = find_ray(address)
    started = not ray.is_initialized()
    if started:
        connect(ray, address)
    try:
        cost = {"num_cpus": 1, "num_gpus": 1 if settings.device.startswith("cuda") else 0, "max_retries": 0}
        evaluate = ray.remote(**cost)(_evaluate_on_one_core)
        # Ray's processes have another working directory and, on a running cluster, another environment.
        here = str(Path.cwd()), os.environ.get(FOLDERS_VARIABLE, "")
        waiting = {evaluate.remote(task, settings, *here): task for task in tasks}
        while waiting:
            finished, _ = ray.wait(list(waiting))
            done = finished[0]
            task = waiting.pop(done)
            try:
                yield task, ray.get(done)
            except ray.exceptions.RayTaskError as error:
                cause = error.cause
                yield task, task.failed(f"{type(cause).__name__}: {' '.join(str(cause).split())}")
            except ray.exceptions.RayError as error:
                reason = " ".join(str(error).split())[:200]
                yield (
                    task,
                    task.failed(f"its process on the cluster died ({reason}); is there enough memory?"),
                )
    finally:
        if started:
            ray.shutdown()


def _evaluate_on_one_core(task: Task, settings: RunSettings, folder: str, weights: str) -> SceneRun:
    """Evaluate a task in the working directory, and with the folders of weights, of the command."""
    import torch

    torch.set_num_threads(1)
    with suppress(OSError):  # another machine, where only absolute paths work
        os.chdir(folder)
    if weights:
        os.environ[FOLDERS_VARIABLE] = weights
    return evaluate_scene(task.scene, task.methods, settings)
