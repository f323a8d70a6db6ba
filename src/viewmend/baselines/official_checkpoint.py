"""Official weights of published networks, from files that the user has: nothing is shipped, nothing downloaded."""

from pathlib import Path
from typing import TypeVar

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

WRAPPER = "netG"
"""DSTT's checkpoint is {"netG": weights}; the others are the weights themselves."""

Network = TypeVar("Network", bound=nn.Module)


class OfficialCheckpointError(ValueError):
    """Weights that cannot be loaded: which file, what was expected, what came, the next step."""


def load_official(network: Network, path: str | Path, device: torch.device | str = "cpu") -> Network:
    """The network with the weights of this file (.pth, .pt or .safetensors), ready to infer.

    Loading is strict: every key and shape must be the network's own. Pickled files are read with
    `weights_only=True`: no code in them is run.

    Raises:
        OfficialCheckpointError: the file is missing, unreadable or cut short, or belongs to another network.
    """
    path, name = Path(path), type(network).__name__
    weights = read_weights(path)
    expected = network.state_dict()
    reshaped = [
        f"{key} {tuple(weights[key].shape)} for {tuple(expected[key].shape)}"
        for key in sorted(expected.keys() & weights.keys())
        if weights[key].shape != expected[key].shape
    ]
    wrong = {
        "missing": sorted(expected.keys() - weights.keys()),
        "unknown": sorted(weights.keys() - expected.keys()),
        "of another shape": reshaped,
    }
    if any(wrong.values()):
        counts = ", ".join(f"{len(keys)} {what} ({', '.join(keys[:2])} ...)" for what, keys in wrong.items() if keys)
        raise OfficialCheckpointError(
            f"{path}: expected the {len(expected)} tensors of {name}, got {len(weights)}: {counts}; give the "
            f"checkpoint of {name}'s generator"
        )
    network.load_state_dict(weights)
    return network.to(device).eval()


def read_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint by key, out of their wrapper; OfficialCheckpointError where there are none."""
    if not path.is_file():
        raise OfficialCheckpointError(f"{path}: expected a checkpoint file, found none; check the path")
    try:
        if path.suffix == ".safetensors":
            contents = load_file(path)
        else:
            contents = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # damaged files raise almost anything
        said = f"{type(error).__name__}: {' '.join(str(error).split()).split('. ')[0][:120]}"
        raise OfficialCheckpointError(
            f"{path}: expected a whole checkpoint of tensors alone, got {path.stat().st_size} bytes that do not read "
            f"({said}); download it again"
        ) from error
    if isinstance(contents, dict) and isinstance(contents.get(WRAPPER), dict):
        contents = contents[WRAPPER]
    if not isinstance(contents, dict) or not all(
        isinstance(key, str) and isinstance(value, Tensor) for key, value in contents.items()
    ):
        raise OfficialCheckpointError(
            f"{path}: expected a dictionary of tensors, plain or under {WRAPPER!r}, got {_kind(contents)}; give the "
            "generator's weights"
        )
    return contents


def _kind(contents: object) -> str:
    return f"a dictionary of {list(contents)[:4]}" if isinstance(contents, dict) else type(contents).__name__
