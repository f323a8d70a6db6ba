"""Evaluation on a Ray cluster: the same function with the same arguments as locally, so the same numbers."""

from collections.abc import Sequence

from viewmend.contrib.ray.cluster import connect, find_ray
from viewmend.evaluation.runner import Runs, Task
from viewmend.evaluation.scene_run import RunSettings, SceneRun, evaluate_scene


def run_on_ray(tasks: Sequence[Task], settings: RunSettings, address: str) -> Runs:
    """The results of all tasks as they finish; each task runs on one core, or on one GPU.

    Machines of the cluster need this package, and captures, people and models at the same paths. A task whose process
    dies fails alone.

    Args:
        tasks: scenes and methods.
        settings: how scenes are run.
        address: of a running cluster (HOST:PORT, ray://HOST:PORT, auto), or `cluster.LOCAL`.

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
        waiting = {evaluate.remote(task, settings): task for task in tasks}
        while waiting:
            (done, *_), _ = ray.wait(list(waiting))
            task = waiting.pop(done)
            try:
                yield task, ray.get(done)
            except ray.exceptions.RayError as error:
                reason = " ".join(str(error).split())[:200]
                yield task, task.failed(f"its process on the cluster died ({reason}); is there enough memory?")
    finally:
        if started:
            ray.shutdown()


def _evaluate_on_one_core(task: Task, settings: RunSettings) -> SceneRun:
    import torch

    torch.set_num_threads(1)
    return evaluate_scene(task.scene, task.methods, settings)
