"""Files of network weights: written atomically, loaded strictly (all names and shapes), and no code is executed."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from viewmend.utils.atomic_writes import write_atomically
from viewmend.utils.untrusted_input import InputError

WRAPPER = "netG"
"""Checkpoints of a GAN's generator may be {"netG": weights}; all others are the weights themselves."""
COUNTER = "num_batches_tracked"
"""Files from before batch norms counted their batches lack these entries, which inference does not need."""

FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
"""Accepted number formats; smaller ones would need scales as well."""

Network = TypeVar("Network", bound=nn.Module)


class WeightsError(InputError):
    """Weights that cannot be loaded: the file, what was expected, what was found, the next step."""


class MissingWeightsError(WeightsError):
    """Published weights that are not installed: names, hash, the folders searched, where to get them."""


class DamagedWeightsError(WeightsError):
    """An unreadable or truncated file."""


class MismatchedWeightsError(WeightsError):
    """A file that does not hold weights, or holds those of another network."""


class _NoRandomWeights(TorchFunctionMode):
    """Functions of `torch.nn.init` that draw random numbers leave a tensor as it is."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if getattr(func, "__module__", "") == nn.init.__name__:
            return kwargs["tensor"]
        return func(*args, **kwargs)


def construct(make: Callable[..., Network], *arguments: Any) -> Network:
    """Call `make`, whose network is about to get its weights from a file, without drawing random weights."""
    with _NoRandomWeights():
        return make(*arguments)


def load_weights(network: Network, path: str | Path, device: torch.device | str = "cpu") -> Network:
    """Load a .safetensors file, or a PyTorch file of weights alone, into a network; set device and evaluation mode.

    Raises:
        DamagedWeightsError: the file is missing, unreadable or truncated.
        MismatchedWeightsError: a tensor is missing, unknown, of another shape or dtype, or not finite.
    """
    weights = read_weights(path)
    path = Path(path)
    own = network.state_dict()
    both = {key: (value, own[key]) for key, value in sorted(weights.items()) if key in own}
    wrong = {
        "missing": sorted(key for key in own.keys() - weights.keys() if not key.endswith(COUNTER)),
        "unknown": sorted(weights.keys() - own.keys()),
        "of another shape": [
            f"{key} {tuple(a.shape)} for {tuple(b.shape)}"
            for key, (a, b) in both.items()
            if a.shape != b.shape
        ],
        "of another kind of number": [
            key for key, (value, wanted) in both.items() if not _is_same_kind(value, wanted)
        ],
        "not finite": [  # in the precision of the network's own tensor
            key
            for key, (a, b) in both.items()
            if a.dtype in FLOATS and not bool(a.to(b.dtype).isfinite().all())
        ],
    }
    if any(wrong.values()):
        counts = ", ".join(
            f"{len(keys)} {what} ({', '.join(keys[:2])} ...)" for what, keys in wrong.items() if keys
        )
        name = type(network).__name__
        raise MismatchedWeightsError(
            f"{path}: expected the {len(own)} tensors of {name}, got {len(weights)}: {counts}; give the weights that "
            f"belong to {name}"
        )
    network.load_state_dict(weights, strict=False)
    return network.to(device).eval()


def _is_same_kind(value: Tensor, wanted: Tensor) -> bool:
    if wanted.is_floating_point():
        return value.dtype in FLOATS
    return not (value.is_floating_point() or value.is_complex())


def read_weights(path: str | Path) -> dict[str, Tensor]:
    """Read the tensors of a file by name, on the CPU, without a wrapping dictionary.

    Raises:
        DamagedWeightsError: the file is missing, unreadable or truncated.
        MismatchedWeightsError: it holds something other than tensors.
    """
    path = Path(path)
    if not path.is_file():
        raise DamagedWeightsError(f"{path}: expected a file of weights, found none; check the path")
    try:
        found = (
            load_file(path) if path.suffix == ".safetensors" else torch.load(path, "cpu", weights_only=True)
        )
    except Exception as error:  # damaged files raise almost any exception
        said = f"{type(error).__name__}: {' '.join(str(error).split()).split('. ')[0][:120]}"
        raise DamagedWeightsError(
            f"{path}: expected a complete file of tensors only, got {path.stat().st_size} bytes that do not read "
            f"({said}); get the file again"
        ) from error
    if isinstance(found, dict) and isinstance(found.get(WRAPPER), dict):
        found = found[WRAPPER]
    if not isinstance(found, dict) or not all(
        isinstance(k, str) and isinstance(v, Tensor) for k, v in found.items()
    ):
        kind = f"a dictionary of {list(found)[:4]}" if isinstance(found, dict) else type(found).__name__
        raise MismatchedWeightsError(
            f"{path}: expected a dictionary of tensors, plain or under '{WRAPPER}', got {kind}; give the "
            "network's weights"
        )
    return found


def write_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> None:
    """Write a safetensors file atomically; tensors may be on any device.

    Raises:
        OSError: it cannot be written.
        FloatingPointError: a value is not finite; an existing file at `path` is unchanged.
    """
    plain = {key: value.detach().cpu().contiguous() for key, value in tensors.items()}
    broken = [
        key for key, value in plain.items() if value.is_floating_point() and not bool(value.isfinite().all())
    ]
    if broken:
        raise FloatingPointError(
            f"{path}: expected finite values, got NaN or infinity in {len(broken)} of {len(plain)} tensors "
            f"({broken[0]}); nothing was written: resume from the last checkpoint with a lower learning rate"
        )

    def write(temporary: Path) -> None:
        try:
            save_file(plain, temporary, dict(metadata))
        except SafetensorError as error:
            raise OSError(f"{path}: expected space for the file, got: {error}; free some space") from error
        temporary.chmod(0o644)

    write_atomically(path, write, durable=True)
