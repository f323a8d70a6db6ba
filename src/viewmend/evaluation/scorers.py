"""What images and videos are compared with: SSIM's window, and networks whose weights are there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.backgrounds import Background
from viewmend.metrics.i3d import I3d
from viewmend.metrics.image_quality import SsimWindow
from viewmend.metrics.lpips import load_lpips
from viewmend.metrics.vfid import MODES, load_i3d, video_features
from viewmend.metrics.weights import MissingWeightsError

ScoreMap = Callable[[Tensor, Tensor], Tensor | None]
"""score(image, truth): a value for each pixel, NaN where there is none; None for images it cannot score."""
CLIP_FRAMES = 16
"""A stream is cut into videos of so many frames for VFID. What is left over is one more if it is half as long, or
alone."""
KINDS = tuple(f"{kind}_{mode}" for mode in MODES for kind in ("whole", "masked"))
"""VFID's readings: whole images or such that are black outside E, by I3D in either mode."""


@dataclass(frozen=True)
class Scorers:
    """How images and videos are compared besides PSNR; None without the weights."""

    ssim: SsimWindow = "gaussian"
    background: Background = "black"
    """What views and truth are laid upon."""
    lpips_alex: ScoreMap | None = None
    lpips_vgg: ScoreMap | None = None
    i3d: I3d | None = None


SSIM_ONLY = Scorers()
FEATURES = 1024
"""Numbers in one of I3D's vectors."""
Features = dict[str, Float[np.ndarray, "clip 1024"]]
"""I3D's vectors of a stream's videos, for each of `KINDS`."""


def load_scorers(ssim: SsimWindow, networks: Sequence[str], device: str, background: Background = "black") -> Scorers:
    """Scorers with these of `NETWORKS`, upon this background.

    Raises:
        WeightsError: one's weights are missing or wrong.
    """
    return Scorers(
        ssim, background, **{field: load(device) for name, (field, load) in NETWORKS.items() if name in networks}
    )


NETWORKS = {
    "lpips-alex": ("lpips_alex", lambda device: load_lpips("alex", device)),
    "lpips-vgg": ("lpips_vgg", lambda device: load_lpips("vgg", device)),
    "i3d": ("i3d", load_i3d),
}
"""Networks by name: the field of `Scorers`, and how it is loaded."""


def available_networks() -> tuple[tuple[str, ...], dict[str, str]]:
    """The `NETWORKS` whose weights are here, and for each other one what is missing.

    Raises:
        WeightsError: weights are here but wrong.
    """
    there, missing = [], {}
    for name, (_, load) in NETWORKS.items():
        try:
            load("cpu")
            there.append(name)
        except MissingWeightsError as error:
            missing[name] = str(error)
    return tuple(there), missing


class VideoFeatures:
    """Gathers a stream's frames into videos, and these into `Features`."""

    def __init__(self, network: I3d | None) -> None:
        self.network = network
        self._frames: list[tuple[Tensor, Tensor]] = []
        self._found: dict[str, list[Tensor]] = {kind: [] for kind in KINDS}

    def add(self, rgb: Float[Tensor, "3 height width"], holes: Tensor) -> None:
        """One more frame, and where E is."""
        if self.network is not None:
            self._frames.append((rgb, rgb * holes))
            if len(self._frames) == CLIP_FRAMES:
                self._cut()

    def features(self) -> Features | None:
        """Features of all frames so far; None without the network, or without frames."""
        cut = self._found[KINDS[0]]
        if self._frames and (not cut or 2 * len(self._frames) >= CLIP_FRAMES):
            self._cut()
        if not cut:
            return None
        return {kind: torch.stack(found).cpu().numpy() for kind, found in self._found.items()}

    def _cut(self) -> None:
        assert self.network is not None, "frames are kept only for it"
        for mode in MODES:
            for kind, frames in zip(("whole", "masked"), zip(*self._frames, strict=True), strict=True):
                self._found[f"{kind}_{mode}"].append(video_features(self.network, frames, mode))
        self._frames = []
