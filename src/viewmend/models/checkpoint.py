"""Models on disk: model.safetensors, config.json and a model card, in the layout of huggingface_hub's mixin."""

import json
from pathlib import Path

import torch

from viewmend.models.network import auto_dtype, set_compute_dtype
from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.models.views.config import RaysConfig, ViewsConfig
from viewmend.models.views.model import ViewSynthNet
from viewmend.models.views.ray_fill import RayFill
from viewmend.utils.atomic_writes import write_text
from viewmend.utils.untrusted_input import bounded_bytes, read_json
from viewmend.utils.weight_files import (
    DamagedWeightsError,
    MismatchedWeightsError,
    WeightsError,
    construct,
    load_weights,
    read_weights,
    write_tensors,
)

FORMAT = 3
"""Format number in config.json; it grows when older versions cannot read new files."""
Model = PatchTransformer | ViewSynthNet | RayFill
Config = PaperConfig | ViewsConfig | RaysConfig
CONFIGS: dict[str, type[Config]] = {"paper": PaperConfig, "views": ViewsConfig, "rays": RaysConfig}
"""Config class by the value of the key `network` in config.json."""
PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
SHIPPED = Path(__file__).parents[1] / "weights"
RAYS = "rays"
"""The shipped model that has no folder of its own: the ray fill within `views`."""
WEIGHTS = "model.safetensors"
CONFIG = "config.json"
CARD = "README.md"


class MissingCheckpointError(WeightsError):
    """The named model does not exist, or a file of it is missing."""


def shipped_models() -> tuple[str, ...]:
    """Names of the models that come with the package."""
    found = {path.parent.name for path in SHIPPED.glob(f"*/{WEIGHTS}")}
    return tuple(sorted(found | ({RAYS} if "views" in found else set())))


def load_inpainter(
    name_or_path: str | Path, device: torch.device | str = "cpu", precision: str = "auto"
) -> Model:
    """Load a shipped model or a model folder, ready for `Stream`.

    Args:
        name_or_path: one of `shipped_models()`, or a folder written by `save_inpainter` (./NAME if
            both exist and the folder is meant).
        device: where it runs.
        precision: float32, bfloat16 (by autocast), or auto: bfloat16 for models trained in it, if
            the device has units for it.

    Raises:
        MissingCheckpointError: there is no such folder or name, or a file is missing.
        DamagedWeightsError: a file is unreadable or truncated.
        MismatchedWeightsError: weights and config do not belong together.
        ValueError: the precision is unknown.

    Examples:
        >>> from viewmend import Inpainter, load_inpainter
        >>> isinstance(load_inpainter("views"), Inpainter)
        True
    """
    if precision not in (*PRECISIONS, "auto"):
        raise ValueError(f"expected a precision of float32, bfloat16 or auto, got '{precision}'")
    network = load_network(name_or_path, device)
    set_compute_dtype(network, auto_dtype(network) if precision == "auto" else PRECISIONS[precision])
    return network


def load_network(name_or_path: str | Path, device: torch.device | str = "cpu") -> Model:
    """Load a model in evaluation mode and float32. Raises as `load_inpainter` does."""
    folder = model_folder(name_or_path)
    config = _read_config(folder / CONFIG)
    with torch.device("meta"):  # allocates nothing before the file is known to be large enough
        needed = sum(weight.numel() for weight in build(config).parameters())
    size = (folder / WEIGHTS).stat().st_size
    if needed > size:
        read_weights(folder / WEIGHTS)  # reports a damaged file as such
        raise MismatchedWeightsError(
            f"{folder}: expected the {needed} weights of its {CONFIG}, got {size} bytes of {WEIGHTS}; copy both files"
        )
    network = load_weights(construct(build, config), folder / WEIGHTS, device)
    if str(name_or_path) == RAYS and isinstance(network, ViewSynthNet) and network.coarse is not None:
        return network.coarse
    return network


def load_config(name_or_path: str | Path) -> Config:
    """Load the config of a model without its weights. Raises as `load_inpainter` does."""
    config = _read_config(model_folder(name_or_path) / CONFIG)
    if str(name_or_path) == RAYS and isinstance(config, ViewsConfig):
        return RaysConfig(num_views=config.num_views)
    return config


def build(config: Config) -> Model:
    """An untrained network of this config."""
    if isinstance(config, PaperConfig):
        return PatchTransformer(config)
    return ViewSynthNet(config) if isinstance(config, ViewsConfig) else RayFill(config)


def save_inpainter(network: Model, folder: str | Path, card: str) -> None:
    """Write the three files. Each is written atomically, so an interruption leaves no partial file.

    `card` is the model card in Markdown: how the model was trained and what it scores.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    kind = next(name for name, config in CONFIGS.items() if isinstance(network.config, config))
    config = {"viewmend_format": FORMAT, "network": kind} | network.config.to_dict()
    write_tensors(folder / WEIGHTS, network.state_dict(), {"format": "pt"})  # first, as it may be refused
    write_text(folder / CONFIG, json.dumps(config, indent=2) + "\n")
    write_text(folder / CARD, card)


def model_folder(name_or_path: str | Path) -> Path:
    """The folder that holds a model's files. Raises `MissingCheckpointError`."""
    name = str(name_or_path)
    folder = SHIPPED / ("views" if name == RAYS else name) if name in shipped_models() else Path(name_or_path)
    if not folder.is_dir():
        raise MissingCheckpointError(
            f"expected a folder or one of the shipped models {list(shipped_models())}, got {name!r}; check it"
        )
    missing = [name for name in (WEIGHTS, CONFIG) if not (folder / name).is_file()]
    if missing:
        raise MissingCheckpointError(
            f"expected a model's folder with {WEIGHTS} and {CONFIG} in {folder}, {' and '.join(missing)} missing; copy "
            f"the whole folder, or name one of the shipped models {list(shipped_models())}"
        )
    return folder


def _read_config(path: Path) -> Config:
    try:
        values = read_json(bounded_bytes(path))
    except (OSError, ValueError) as error:
        raise DamagedWeightsError(f"{path}: {error}; copy the file again") from error
    version = values.pop("viewmend_format", None) if isinstance(values, dict) else None
    if version != FORMAT:
        raise MismatchedWeightsError(
            f"{path}: expected viewmend_format {FORMAT}, got {version}; use the version of viewmend that wrote it"
        )
    try:
        kind = values.pop("network", None)
        if kind not in CONFIGS:
            raise ValueError(f"expected the network {', '.join(CONFIGS)}, got {kind!r}")
        return CONFIGS[kind].from_dict(values)
    except (TypeError, ValueError) as error:
        raise MismatchedWeightsError(f"{path}: {error}") from error
