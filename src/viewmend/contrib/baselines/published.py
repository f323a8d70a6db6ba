"""Published networks by name, with weights of their authors or of our training.

`NETWORK-o-FRAMING`: a network of `NETWORKS`; o for online; def, win or mul
(`OnlineConfig.framing`). Then, optionally, `-relative` (`Sampling.grid`). The weights are the
authors'; with `-finetuned` those that our training wrote to `finetuned/NETWORK/`, with `@PATH`
those of a run's folder, or of a file.
"""

import re
from collections.abc import Callable
from pathlib import Path

import torch

from viewmend.contrib.baselines.e2fgvi import E2FGVI, E2FGVIHQ
from viewmend.contrib.baselines.online import OnlineConfig, OnlineInpainter, Sampling
from viewmend.contrib.baselines.token_transformers import DSTT, FuseFormer
from viewmend.metrics.weights import KnownWeights, checked_weights, known_weights
from viewmend.models.base import Inpainter
from viewmend.utils.weight_files import construct, load_weights

NETWORKS: dict[str, Callable[[], DSTT | FuseFormer | E2FGVI]] = {
    "dstt": DSTT,
    "fuseformer": FuseFormer,
    "e2fgvi": E2FGVI,
    "e2fgvi-hq": E2FGVIHQ,
}
"""The published networks by the names of methods, weights and recipes."""
TRAINED = "model.safetensors"
"""The weights in the folder of a run."""
_NAME = re.compile(
    rf"(?P<network>{'|'.join(NETWORKS)})-o-(?P<framing>def|win|mul)(?P<grid>-relative)?"
    r"(?P<weights>-finetuned|@.+)?"
)


def make_baseline(name: str, device: torch.device | str = "cpu") -> Inpainter:
    """The inpainter of this name, never with random weights.

    Raises:
        MissingWeightsError: its weights were not found.
        ValueError: no such name; or the weights are damaged or another network's (`WeightsError`).
    """
    found = _NAME.fullmatch(name)
    if found:
        network = load_baseline(found["network"], found["weights"] or "", device)
        sampling = Sampling(grid="relative" if found["grid"] else "absolute")
        # pyrefly: ignore[bad-argument-type]
        config = OnlineConfig(framing=found["framing"], sampling=sampling)
        return OnlineInpainter(network, config)
    raise ValueError(f"expected a name like dstt-o-def, got '{name}'; the networks are {', '.join(NETWORKS)}")


def load_baseline(
    network: str, weights: str = "", device: torch.device | str = "cpu"
) -> DSTT | FuseFormer | E2FGVI:
    """A network of `NETWORKS` with its authors' weights (""), with ours ("-finetuned"), or with a file's ("@PATH")."""
    if weights.startswith("@"):
        path = Path(weights[1:])
        path = path / TRAINED if path.is_dir() else path
    else:
        path = checked_weights(finetuned_weights(network) if weights else known_weights(network))
    return load_weights(construct(NETWORKS[network]), path, device)


def finetuned_weights(network: str) -> KnownWeights:
    """Where the weights of a network that our training fine-tuned are looked for."""
    file = f"finetuned/{network}/{TRAINED}"
    made_by = f"viewmend train {network} --from CHECKPOINT --out PLACE/finetuned/{network}"
    return KnownWeights(
        f"{network}-finetuned", (file,), f"{network} as fine-tuned here", made_by, "the user's"
    )
