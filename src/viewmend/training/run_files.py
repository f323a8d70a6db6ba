"""The files of a run: its checkpoint (run.safetensors), its log (log.jsonl, TensorBoard) and the model card."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.optim import Optimizer

from viewmend.training.config import TrainConfig
from viewmend.training.replay import ReplayPosition
from viewmend.utils.atomic_writes import TEMPORARY, name_path_in_errors, write_text
from viewmend.utils.untrusted_input import InputError
from viewmend.utils.weight_files import write_tensors

CHECKPOINT = "run.safetensors"
"""The last checkpoint has this name."""
PREVIOUS_CHECKPOINT = "run.previous.safetensors"
"""The checkpoint before the last has this name."""
MAY_CHANGE = (
    "steps",
    "minutes",
    "workers",
    "microbatch",
    "checkpoint_minutes",
    "validate_every",
    "validation_views",
    "learning_rate",
)
"""Fields of the config that may differ when a run is resumed."""


class RunError(InputError):
    """A run cannot be resumed."""


@dataclass(frozen=True)
class RunState:
    """Progress of a run, as stored in a checkpoint."""

    step: int
    """Steps done."""
    elapsed_s: float
    positions: tuple[ReplayPosition, ...]
    """Positions of all streams, in their order."""
    best_score: float | None = None
    """Score of the weights that are kept, in runs that keep the best."""
    best_step: int = 0


@dataclass(frozen=True)
class Progress:
    """One step of a run, as logged."""

    step: int
    """Steps done."""
    progress: float
    """Fraction of the run that was done before this step, in [0, 1]."""
    learning_rate: float
    losses: dict[str, float]
    """Losses by name: inside (L_in), outside (L_out), total, adversarial (L_adv), discriminator;
    streams averaged."""
    elapsed_s: float
    samples_per_s: float
    waiting: float
    """Fraction of the time that was spent waiting for samples."""
    eta_s: float
    """Estimated time to the end."""
    validation: dict[str, float | None] = field(default_factory=dict)
    """The latest validation's scores; {} before the first."""


def save_run(
    folder: Path,
    config: TrainConfig,
    state: RunState,
    modules: dict[str, nn.Module],
    optimizers: dict[str, Optimizer],
) -> None:
    """Write a checkpoint; the one that was there becomes the previous one."""
    tensors = {f"{name}/{key}": value for name, m in modules.items() for key, value in m.state_dict().items()}
    for name, optimizer in optimizers.items():
        for number, values in optimizer.state_dict()["state"].items():
            tensors |= {f"{name}/{number}/{key}": torch.as_tensor(value) for key, value in values.items()}
    metadata = {"state": json.dumps(asdict(state)), "config": json.dumps(_flat(config))}
    unfinished = folder / f"{TEMPORARY}{CHECKPOINT}"
    write_tensors(unfinished, tensors, metadata)
    if (folder / CHECKPOINT).exists():
        (folder / CHECKPOINT).replace(folder / PREVIOUS_CHECKPOINT)
    unfinished.replace(folder / CHECKPOINT)


def last_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint in a run's folder; None if there is none."""
    return next(
        (folder / name for name in (CHECKPOINT, PREVIOUS_CHECKPOINT) if (folder / name).exists()), None
    )


def load_run(
    path: Path, config: TrainConfig, modules: dict[str, nn.Module], optimizers: dict[str, Optimizer]
) -> RunState:
    """Load a checkpoint into the modules and optimisers of its config; RunError if it is damaged or has another one."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata()
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        stored = json.loads(metadata["config"])
        own = _flat(config)
        values = json.loads(metadata["state"])
        different = [
            key for key in {**own, **stored} if key not in MAY_CHANGE and own.get(key) != stored.get(key)
        ]
    except (
        OSError,
        SafetensorError,
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
        RecursionError,
    ) as error:
        raise RunError(f"{path}: expected a run to resume, got {error}; {_advice(path)}") from error
    if different:
        raise RunError(
            f"{path}: expected a run with this config, got one that differs in {', '.join(different)}; choose another "
            "folder, or pass the options that the run was started with"
        )
    try:
        for name, module in modules.items():
            module.load_state_dict(_with_prefix(name, tensors))
        for name, optimizer in optimizers.items():
            _load_optimizer(optimizer, _with_prefix(name, tensors))
        positions = tuple(ReplayPosition(**position) for position in values["positions"])
        return RunState(
            step=values["step"],
            elapsed_s=values["elapsed_s"],
            positions=positions,
            best_score=values.get("best_score"),
            best_step=values.get("best_step", 0),
        )
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise RunError(
            f"{path}: expected a run of this version, got one whose values do not fit ({reason}); {_advice(path)}"
        ) from error


def _advice(path: Path) -> str:
    if path.name == CHECKPOINT and path.with_name(PREVIOUS_CHECKPOINT).exists():
        return (
            f"remove the file to resume from the checkpoint before, {PREVIOUS_CHECKPOINT}, or remove both to "
            "start again"
        )
    return "remove the file to start again"


def _with_prefix(name: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tensors of the module or optimiser `name`, under their names in it."""
    prefix = f"{name}/"
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


def _load_optimizer(optimizer: Optimizer, tensors: dict[str, Tensor]) -> None:
    states: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        number, key = name.split("/")
        states.setdefault(int(number), {})[key] = value
    groups = optimizer.state_dict()["param_groups"]
    count = sum(len(group["params"]) for group in groups)
    # Parameters that never had a gradient have no moments
    if not states.keys() <= set(range(count)) or len({frozenset(state) for state in states.values()}) > 1:
        raise ValueError(f"moments of {len(states)} parameters for {count}")
    optimizer.load_state_dict({"state": states, "param_groups": groups})


def _flat(config: TrainConfig) -> dict[str, Any]:
    """The config's values as JSON has them, by dotted names."""

    def flat(values: dict[str, Any], prefix: str) -> dict[str, Any]:
        found = {}
        for key, value in values.items():
            found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
        return found

    return flat(json.loads(json.dumps(asdict(config), default=str)), "")


class Log:
    """The log of a run: a line of JSON per step, and TensorBoard files if it is installed.

    Opened at a step, it drops the entries of later ones.
    """

    def __init__(self, out: Path, step: int, writes: bool) -> None:
        """`writes` is False in all processes but the first, which write nothing."""
        self._file = None
        self._board = None
        if not writes:
            return
        path = out / "log.jsonl"
        self._path = path
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
        write_text(path, "".join(line for line in lines if line.endswith("\n") and not _is_later(line, step)))
        self._file = path.open("a", encoding="utf-8")
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
        """Log a step."""
        values = asdict(progress)
        del values["validation"]  # it has a line of its own
        self._write(values)
        rates = {name: getattr(progress, name) for name in ("learning_rate", "samples_per_s", "waiting")}
        self._plot(progress.step, "loss", progress.losses)
        self._plot(progress.step, "rate", rates)

    def add_validation(self, step: int, scores: Mapping[str, float | None]) -> None:
        """Log the scores of the averaged weights after a step."""
        self._write({"step": step, "validation": dict(scores)})
        self._plot(step, "validation", {name: score for name, score in scores.items() if score is not None})

    def first_validation(self) -> dict[str, float | None]:
        """The scores of the run's first validation; {} before it."""
        if self._file is None:
            return {}
        entries = map(json.loads, self._path.read_text(encoding="utf-8").splitlines())
        return next((entry["validation"] for entry in entries if "validation" in entry), {})

    def _write(self, values: Mapping[str, object]) -> None:
        if self._file is not None:
            with name_path_in_errors(self._path):
                self._file.write(json.dumps(values) + "\n")
                self._file.flush()

    def _plot(self, step: int, group: str, values: Mapping[str, float]) -> None:
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(f"{group}/{name}", value, step)


def read_validations(out: Path) -> list[tuple[int, dict[str, float | None]]]:
    """The steps and scores of all validations in the log of the run in `out`; empty without a log."""
    path = out / "log.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    entries = [json.loads(line) for line in lines]
    return [(entry["step"], entry["validation"]) for entry in entries if "validation" in entry]


def _is_later(line: str, step: int) -> bool:
    """Whether a line of the log belongs to a later step; lines without a step do not."""
    try:
        return json.loads(line)["step"] > step
    except (ValueError, TypeError, KeyError, RecursionError):
        return False


def model_card(config: TrainConfig, state: RunState, num_streams: int, loss_summary: str) -> str:
    """The README.md of trained weights, in Markdown: how they were trained; scores are added by hand."""
    hardware = (
        torch.cuda.get_device_name()
        if torch.cuda.is_available()
        else f"{torch.get_num_threads()} CPU threads"
    )
    averaged = "; averaged weights" if config.ema else ""
    start = "random weights" if config.start is None else f"`{config.start}`"
    return f"""# {config.name}

Trained by `viewmend train {config.name}` from {start}: {state.step} steps of {config.batch} samples
x {num_streams} streams in {state.elapsed_s / 60:.0f} minutes, learning rate {config.learning_rate:g},
seed {config.seed}, torch {torch.__version__}, {hardware}.
Loss: {loss_summary}{averaged}.
Data: {_data_summary(config)}; no test seeds, performers or motions.
"""


def _data_summary(config: TrainConfig) -> str:
    scenes = config.scenes
    if config.shards is not None:
        return f"a data set written by `viewmend make-dataset` ({config.shards.name})"
    studio = "studio scenes generated during training"
    if scenes.performers is not None:
        studio += f", {scenes.performers_fraction:.0%} of them with glTF performers"
    if not scenes.captures:
        return studio
    names = ", ".join(place.stem for place in scenes.captures)
    return f"{scenes.captures_fraction:.0%} of the scenes from captures ({names}), the others {studio}"
