"""What is handed out to workers."""

from dataclasses import dataclass

from viewmend.leave_one_out.scenes import LeaveOneOutScene


@dataclass(frozen=True)
class Task:
    """One call of `evaluate_scene`: all the methods that a scene lacks."""

    scene: LeaveOneOutScene
    methods: tuple[str, ...]
