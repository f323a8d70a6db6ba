"""Published networks by name, with weights that their authors, or our training, left in a file.

`NETWORK-VARIANT-FRAMING`: a network of `NETWORKS`; o or om (`OnlineConfig.memory`); def, win or mul
(`OnlineConfig.framing`). Then, if wanted, `-relative` (`Sampling.grid`). The weights are the authors'; with
`-finetuned` those that our training left in `finetuned/NETWORK/`, with `@PATH` those of a run's folder, or of a file.
`riftcast` and `riftcast-published` are DSTT as RIFTCast runs it.
"""

import re
from collections.abc import Callable
from pathlib import Path

import torch

from viewmend.contrib.baselines.clips import Sampling
from viewmend.contrib.baselines.dstt import DSTT
from viewmend.contrib.baselines.e2fgvi import E2FGVI, E2FGVIHQ
from viewmend.contrib.baselines.fuseformer import FuseFormer
from viewmend.contrib.baselines.online import OnlineConfig, OnlineInpainter
from viewmend.contrib.baselines.riftcast import RiftCast
from viewmend.metrics.weights import KnownWeights, checked_weights, known_weights
from viewmend.models.base import Inpainter
from viewmend.utils.weight_files import load_weights

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
    rf"(?P<network>{'|'.join(NETWORKS)})-(?P<variant>om|o)-(?P<framing>def|win|mul)(?P<grid>-relative)?"
    r"(?P<weights>-finetuned|@.+)?"
)
_RIFTCAST = re.compile(r"riftcast(?P<published>-published)?(?P<weights>-finetuned|@.+)?")


def make_baseline(name: str, device: torch.device | str = "cpu") -> Inpainter:
    """The inpainter of this name, never with random weights.

    Raises:
        MissingWeightsError: its weights are nowhere.
        ValueError: no such name; or the weights are damaged or another network's (`WeightsError`).
    """
    if found := _NAME.fullmatch(name):
        network = load_baseline(found["network"], found["weights"] or "", device)
        sampling = Sampling(grid="relative" if found["grid"] else "absolute")
        framing, memory = found["framing"], found["variant"] == "om"
        return OnlineInpainter(network, OnlineConfig(framing=framing, memory=memory, sampling=sampling))  # pyright: ignore[reportArgumentType]
    if found := _RIFTCAST.fullmatch(name):
        network = load_baseline("dstt", found["weights"] or "", device)
        assert isinstance(network, DSTT)
        return RiftCast(network, as_published=bool(found["published"]))
    raise ValueError(f"expected a name like dstt-o-def, got '{name}'; the networks are {', '.join(NETWORKS)}")


def load_baseline(network: str, weights: str = "", device: torch.device | str = "cpu") -> DSTT | FuseFormer | E2FGVI:
    """A network of `NETWORKS` with its authors' weights (""), with ours ("-finetuned"), or with a file's ("@PATH")."""
    if weights.startswith("@"):
        path = Path(weights[1:])
        path = path / TRAINED if path.is_dir() else path
    else:
        path = checked_weights(finetuned_weights(network) if weights else known_weights(network))
    return load_weights(NETWORKS[network](), path, device)


def finetuned_weights(network: str) -> KnownWeights:
    """Where the weights of a network that our training fine-tuned are looked for."""
    file = f"finetuned/{network}/{TRAINED}"
    made_by = f"viewmend train {network} --from CHECKPOINT --out PLACE/finetuned/{network}"
    return KnownWeights(f"{network}-finetuned", (file,), f"{network} as fine-tuned here", made_by, "the user's")
