"""Inpainters on disk: model.safetensors, config.json and a model card, in the layout of huggingface_hub's mixin."""

import json
from pathlib import Path

import torch

from viewmend.atomic_writes import write_tensors, write_text
from viewmend.foreign_input import bounded_bytes
from viewmend.inpainting.chain import Chain, build
from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.network import auto_dtype, set_compute_dtype
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.inpainting.temporal_accumulation import TemporalAccumulation
from viewmend.json_input import read_json
from viewmend.weight_files import DamagedWeightsError, MismatchedWeightsError, WeightsError, load_weights, read_weights

FORMAT = 2
"""Grows when an older program could no longer read what is written. Format 1, of one network with switches, is read."""
Mender = Chain | PatchTransformer | SweepNet
NETWORK, SWEEP = "network", "sweep"
"""Key and value of config.json that tell a `SweepNet`; without it, a `Chain` or a `PatchTransformer`."""
PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
SHIPPED = Path(__file__).parents[1] / "weights"
WEIGHTS, CONFIG, CARD = "model.safetensors", "config.json", "README.md"


class MissingCheckpointError(WeightsError):
    """No such model."""


def shipped_models() -> tuple[str, ...]:
    """Names of the models that come with the package."""
    return tuple(sorted(p.parent.name for p in SHIPPED.glob(f"*/{WEIGHTS}")))


def load_inpainter(
    name_or_path: str | Path, device: torch.device | str = "cpu", precision: str = "auto"
) -> Mender | TemporalAccumulation:
    """The inpainter in this folder, or the shipped one of this name, ready for `Stream`.

    Args:
        name_or_path: a name of `shipped_models()`, or a folder that `save_inpainter` wrote.
        device: where it computes.
        precision: what its layers compute in: float32, or bfloat16 by autocast; auto is bfloat16 for models that were
            trained in it, where this machine is clearly faster in it.

    Raises:
        MissingCheckpointError: there is no such folder or name, or a file of it is missing.
        DamagedWeightsError: a file is unreadable or cut short.
        MismatchedWeightsError: weights and config do not belong together.
        ValueError: no such precision.

    Examples:
        >>> from viewmend import ViewInpainter, load_inpainter
        >>> isinstance(load_inpainter("small"), ViewInpainter)
        True
    """
    if precision not in (*PRECISIONS, "auto"):
        raise ValueError(f"expected --precision float32, bfloat16 or auto, got '{precision}'")
    network = load_network(name_or_path, device)
    set_compute_dtype(network, auto_dtype(network) if precision == "auto" else PRECISIONS[precision])
    weight = 0.0 if isinstance(network, SweepNet) else network.config.temporal_accumulation
    return TemporalAccumulation(network, weight) if weight else network


def load_network(name_or_path: str | Path, device: torch.device | str = "cpu") -> Mender:
    """The networks alone, without temporal accumulation, in evaluation mode. Raises as `load_inpainter` does."""
    folder = _folder(name_or_path)
    version, config = _read_config(folder / CONFIG)
    with torch.device("meta"):  # nothing is allocated that the file cannot hold
        wanted = sum(weight.numel() for weight in _built(config).parameters())
    if wanted > (there := (folder / WEIGHTS).stat().st_size):
        read_weights(folder / WEIGHTS)  # which says that they are damaged, if they are
        raise MismatchedWeightsError(
            f"{folder}: expected the {wanted} weights of its {CONFIG}, got {there} bytes of {WEIGHTS}; copy both files"
        )
    network = _built(config)
    rename = _renamed if version == 1 and isinstance(network, Chain) else None
    return load_weights(network, folder / WEIGHTS, device, rename=rename)


def load_config(name_or_path: str | Path) -> InpainterConfig | SweepConfig:
    """The config of an inpainter, without its weights. Raises as `load_inpainter` does."""
    return _read_config(_folder(name_or_path) / CONFIG)[1]


def save_inpainter(network: Mender, folder: str | Path, card: str) -> None:
    """Writes the three files; each is whole or not there, also when the machine stops halfway.

    `card` is the model card in Markdown: what trained the model and what it scores.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    kind = {NETWORK: SWEEP} if isinstance(network, SweepNet) else {}
    config = {"viewmend_format": FORMAT} | kind | network.config.to_dict()
    write_text(folder / CONFIG, json.dumps(config, indent=2) + "\n")
    write_text(folder / CARD, card)
    write_tensors(folder / WEIGHTS, network.state_dict(), {"format": "pt"})


def _built(config: InpainterConfig | SweepConfig) -> Mender:
    return SweepNet(config) if isinstance(config, SweepConfig) else build(config)


def _renamed(key: str) -> str:
    """A weight of format 1 by its name within a `Chain`."""
    reader = "ray_reader."
    return f"coarse.{key.removeprefix(reader)}" if key.startswith(reader) else f"patches.{key}"


def _folder(name_or_path: str | Path) -> Path:
    folder = Path(name_or_path)
    if not folder.is_dir() and str(name_or_path) in shipped_models():
        folder = SHIPPED / str(name_or_path)
    if not folder.is_dir():
        raise MissingCheckpointError(
            f"expected a folder or one of the shipped models {list(shipped_models())}, got {str(name_or_path)!r}"
        )
    absent = [name for name in (WEIGHTS, CONFIG) if not (folder / name).is_file()]
    if absent:
        raise MissingCheckpointError(
            f"{folder}: expected {WEIGHTS} and {CONFIG}, {' and '.join(absent)} missing; copy the whole folder"
        )
    return folder


def _read_config(path: Path) -> tuple[int, InpainterConfig | SweepConfig]:
    try:
        values = read_json(bounded_bytes(path))
    except (OSError, ValueError) as error:
        raise DamagedWeightsError(f"{path}: expected JSON, got {error}; copy the file again") from error
    version = values.pop("viewmend_format", None) if isinstance(values, dict) else None
    if version not in (1, FORMAT):
        raise MismatchedWeightsError(
            f"{path}: expected viewmend_format 1 or {FORMAT}, got {version}; use the version of viewmend that wrote it"
        )
    try:
        kind = values.pop(NETWORK, "chain")
        if kind not in ("chain", SWEEP):
            raise ValueError(f"expected the network 'chain' or '{SWEEP}', got {kind!r}")
        return version, SweepConfig.from_dict(values) if kind == SWEEP else InpainterConfig.from_dict(values)
    except (TypeError, ValueError) as error:
        raise MismatchedWeightsError(f"{path}: {error}") from error
