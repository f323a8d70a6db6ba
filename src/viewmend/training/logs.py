"""What a run writes down of itself: a line of JSON a step, and TensorBoard's files where that is installed."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from viewmend.atomic_writes import naming, write_text
from viewmend.training.schedule import Pace
from viewmend.training.validation import ValidationScores, WholeViewScores


@dataclass(frozen=True)
class LossTerms:
    """What one step cost, the mean of all streams."""

    inside: float
    """L_in."""
    outside: float
    """L_out."""
    total: float
    """The weighted sum with every term that is switched on."""
    adversarial: float = 0.0
    """L_adv, the inpainter's side."""
    discriminator: float = 0.0
    """What D minimises."""


@dataclass(frozen=True)
class Progress:
    """One step of a run, as the log has it."""

    step: int
    """Steps that were made."""
    progress: float
    """Share of the run before this one, 0 to 1."""
    learning_rate: float
    losses: LossTerms
    elapsed_s: float
    pace: Pace


class Log:
    """The log of a run in its folder; opened at a step, it forgets what was written of later ones."""

    def __init__(self, out: Path, step: int, writes: bool) -> None:
        """`writes`: False for all processes but the first, which write nothing."""
        self._file = self._board = None
        if not writes:
            return
        self._path = path = out / "log.jsonl"
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
        kept = "".join(line for line in lines if line.endswith("\n") and not _is_later(line, step))
        write_text(path, kept)
        self._file = path.open("a")
        try:
            from torch.utils.tensorboard import SummaryWriter  # type: ignore[attr-defined]
        except ImportError:
            return
        self._board = SummaryWriter(str(out / "tensorboard"), purge_step=step)

    def __enter__(self) -> "Log":
        return self

    def __exit__(self, *_: object) -> None:
        for sink in (self._file, self._board):
            if sink is not None:
                sink.close()

    def add(self, progress: Progress) -> None:
        """A step."""
        self._write(asdict(progress))
        self._plot(progress.step, {f"loss/{n}": v for n, v in asdict(progress.losses).items()})
        rates = {"samples_per_s": progress.pace.samples_per_s, "waiting": progress.pace.waiting}
        rates["learning_rate"] = progress.learning_rate
        self._plot(progress.step, {f"rate/{n}": v for n, v in rates.items()})

    def validated(self, scores: ValidationScores | WholeViewScores) -> None:
        """What the averaged weights scored after a step."""
        self._write({"step": scores.step, "validation": asdict(scores)})
        self._plot(
            scores.step,
            {f"validation/{n}": v for n, v in asdict(scores).items() if n != "step" and v is not None},
        )

    def _write(self, values: Mapping[str, object]) -> None:
        if self._file is not None:
            with naming(self._path):
                self._file.write(json.dumps(values) + "\n")
                self._file.flush()

    def _plot(self, step: int, values: Mapping[str, float]) -> None:
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(name, value, step)


def _is_later(line: str, step: int) -> bool:
    """Whether a line of the log is of a later step; one that says no step stays."""
    try:
        return json.loads(line)["step"] > step
    except (ValueError, TypeError, KeyError, RecursionError):
        return False
