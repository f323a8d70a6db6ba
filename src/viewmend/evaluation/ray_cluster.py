"""Scenes on a Ray cluster: the same function of the same arguments as here, so the same numbers."""

from collections.abc import Iterator, Sequence

from viewmend.cluster import connect, find_ray
from viewmend.evaluation.scene_run import MethodRun, RunSettings, SceneRun, evaluate_scene
from viewmend.evaluation.tasks import Task
from viewmend.leave_one_out.scenes import LeaveOneOutScene


def run_on_ray(tasks: Sequence[Task], settings: RunSettings, address: str) -> Iterator[tuple[Task, SceneRun]]:
    """The runs of all tasks, in the order in which they are done, one task on one core, or on one GPU.

    Machines of the cluster need this package, and captures, people and models under the same paths. A task whose
    process dies fails alone.

    Args:
        tasks: what to run.
        settings: how.
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
