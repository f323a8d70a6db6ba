"""What is handed out to workers."""

from dataclasses import dataclass

from viewmend.evaluation.scenes import EvaluationScene


@dataclass(frozen=True)
class Task:
    """One call of `evaluate_scene`: all the methods that a scene lacks."""

    scene: EvaluationScene
    methods: tuple[str, ...]
