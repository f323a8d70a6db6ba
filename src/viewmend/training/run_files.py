"""A run on disk: what it takes to go on (run.safetensors), whole or not there."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn
from torch.optim import Optimizer

from viewmend.atomic_writes import HALF, write_tensors
from viewmend.foreign_input import InputError
from viewmend.training.plan import Recipe
from viewmend.training.replay import ReplayPosition

FILE, PREVIOUS = "run.safetensors", "run.previous.safetensors"
"""The last checkpoint, and the one before it."""
MAY_CHANGE = ("steps", "minutes", "workers", "checkpoint_every", "validate_every", "validation_views")
"""Parts of a recipe that a run may go on with another value of."""


class RunError(InputError):
    """A run that cannot go on: which file, what was expected, what came, the next step."""


@dataclass(frozen=True)
class RunState:
    """Where a run is."""

    step: int
    """Steps that were made."""
    elapsed_s: float
    positions: tuple[ReplayPosition, ...]
    """Where all streams are, in their order."""


def save_run(
    folder: Path, recipe: Recipe, state: RunState, modules: dict[str, nn.Module], optimizers: dict[str, Optimizer]
) -> None:
    """Write the run; the checkpoint that was there becomes the previous one."""
    tensors = {f"{name}/{key}": value for name, m in modules.items() for key, value in m.state_dict().items()}
    for name, optimizer in optimizers.items():
        for number, values in optimizer.state_dict()["state"].items():
            tensors |= {f"{name}/{number}/{key}": torch.as_tensor(value) for key, value in values.items()}
    metadata = {"state": json.dumps(asdict(state)), "recipe": json.dumps(_plain(recipe))}
    next_one = folder / f"{HALF}{FILE}"
    write_tensors(next_one, tensors, metadata)
    if (folder / FILE).exists():
        (folder / FILE).replace(folder / PREVIOUS)
    next_one.replace(folder / FILE)


def last_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint that a run left; None where there is none."""
    return next((folder / name for name in (FILE, PREVIOUS) if (folder / name).exists()), None)


def load_run(path: Path, recipe: Recipe, modules: dict[str, nn.Module], optimizers: dict[str, Optimizer]) -> RunState:
    """Put a run's values into the modules and optimizers that its recipe makes.

    Raises:
        RunError: the file is damaged, or another recipe wrote it.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata()
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        wrote, values = json.loads(metadata["recipe"]), json.loads(metadata["state"])
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise RunError(f"{path}: expected a run to go on with, got {error}; {_way_on(path)}") from error
    mine = _plain(recipe)
    other = [key for key in mine if key not in MAY_CHANGE and mine[key] != wrote.get(key)]
    if other:
        raise RunError(
            f"{path}: expected a run of this recipe, got one that differs in {', '.join(other)}; write to another "
            "folder, or give the options that it was started with"
        )
    try:
        for name, module in modules.items():
            module.load_state_dict(_under(name, tensors))
        for name, optimizer in optimizers.items():
            _load_optimizer(optimizer, _under(name, tensors))
        positions = tuple(ReplayPosition(**position) for position in values["positions"])
        return RunState(values["step"], values["elapsed_s"], positions)
    except (RuntimeError, KeyError, TypeError, ValueError, AttributeError) as error:
        said = " ".join(str(error).split())[:200]
        raise RunError(
            f"{path}: expected a run of this version, got one whose values do not fit ({said}); {_way_on(path)}"
        ) from error


def _way_on(path: Path) -> str:
    if path.name == FILE and path.with_name(PREVIOUS).exists():
        return f"remove the file to start anew, or put {PREVIOUS} in its place to go on from the checkpoint before"
    return "remove the file to start anew"


def _under(name: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    prefix = f"{name}/"
    return {key.removeprefix(prefix): value for key, value in tensors.items() if key.startswith(prefix)}


def _load_optimizer(optimizer: Optimizer, tensors: dict[str, Tensor]) -> None:
    states: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        number, key = name.split("/")
        states.setdefault(int(number), {})[key] = value
    groups = optimizer.state_dict()["param_groups"]
    count = sum(len(group["params"]) for group in groups)
    if states and (set(states) != set(range(count)) or len({frozenset(state) for state in states.values()}) > 1):
        raise ValueError(f"moments of {len(states)} parameters for {count}")
    optimizer.load_state_dict({"state": states, "param_groups": groups})


def _plain(recipe: Recipe) -> dict[str, Any]:
    """The recipe as JSON has it."""
    return json.loads(json.dumps(asdict(recipe), default=str))
