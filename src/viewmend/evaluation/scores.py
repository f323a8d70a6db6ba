"""The scorer of `mend`, `demo` and `evaluate`: a completed view against the image of a held-out camera (section 10)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.geometry.hull import FOREGROUND
from viewmend.metrics.image_quality import SsimWindow, change, mask_iou, psnr, ssim_map, warp_error
from viewmend.metrics.lpips import load_lpips
from viewmend.metrics.vfid import MODES, I3d, load_i3d, video_features
from viewmend.models.compositing import Background, camera_image, composite
from viewmend.scenes.true_visibility import PixelOrigins
from viewmend.types import CompletedView, IncompleteView, MultiViewFrame
from viewmend.utils.weight_files import MissingWeightsError

MIN_HOLE_PX = 50
"""Frames with fewer hole pixels are left out of mean scores in the holes: their PSNR is mostly noise."""
STILL = 0.02
"""A pixel of the truth counts as still if no channel changes by more, in [0, 1]."""
CLIP_FRAMES = 16
"""Length of the videos of VFID. The rest of a stream is a video, too, if it is half as long
or the only one."""
FEATURES = 1024
"""Length of I3D's feature vectors."""
KINDS = tuple(f"{kind}_{mode}" for mode in MODES for kind in ("whole", "masked"))
"""Readings of VFID: whole images, or images blackened outside the holes; I3D in either mode."""
Features = dict[str, Float[np.ndarray, "clip 1024"]]
"""I3D's feature vectors of the videos of a stream, for each of `KINDS`."""
ScoreMap = Callable[[Tensor, Tensor], Tensor | None]
"""score(image, truth): a value for each pixel, NaN where undefined; None for images that are too small."""
NETWORKS: dict[str, tuple[str, Callable[[str], object]]] = {
    "lpips-alex": ("lpips_alex", lambda device: load_lpips("alex", device).map),
    "lpips-vgg": ("lpips_vgg", lambda device: load_lpips("vgg", device).map),
    "i3d": ("i3d", load_i3d),
}
"""Networks of metrics: the field of `Scorers`, and the function that loads them."""


@dataclass(frozen=True)
class Scorers:
    """Background of the comparison and metrics besides PSNR; None skips a metric."""

    background: Background = "black"
    """Background on which views and truth are composited."""
    ssim: SsimWindow | None = "gaussian"
    lpips_alex: ScoreMap | None = None
    lpips_vgg: ScoreMap | None = None
    i3d: I3d | None = None


def load_scorers(background: Background, ssim: SsimWindow, networks: Sequence[str], device: str) -> Scorers:
    """Scorers with some of `NETWORKS`.

    Raises:
        WeightsError: weights are missing or wrong.
    """
    loaded: dict[str, Any] = {
        field: load(device) for name, (field, load) in NETWORKS.items() if name in networks
    }
    return Scorers(background, ssim, **loaded)


def available_networks() -> tuple[tuple[str, ...], dict[str, str]]:
    """The `NETWORKS` whose weights are installed, and the reason for each other one.

    Raises:
        WeightsError: weights are installed but wrong.
    """
    there = []
    missing = {}
    for name, (_, load) in NETWORKS.items():
        try:
            load("cpu")
            there.append(name)
        except MissingWeightsError as error:
            missing[name] = str(error)
    return tuple(there), missing


@dataclass(frozen=True, kw_only=True)
class ViewScores:
    """Scores of one view: PSNR in dB, SSIM in [-1, 1], differences in [0, 1]; None where there is nothing to score.

    PSNR, SSIM and LPIPS have four readings: `whole`, over all pixels; `holes`, over the holes only
    (a); `holes_fg`, over the holes inside the true mask; `masked`, over all pixels of images
    blackened outside the holes (b). SSIM and LPIPS over some pixels are means of the maps of the
    unmasked images. The holes are `IncompleteView.holes`, whatever the error rule.
    """

    time: int
    width_px: int
    height_px: int
    hull_px: int
    """Pixels that the geometry proxy covers."""
    hole_px: int
    hole_fg_px: int
    sources_px: int = 0
    """Holes whose surface a source camera sees now, although the proxy hides it (`psnr_sources`)."""
    others_px: int = 0
    """Holes whose surface only cameras besides the sources see now (`psnr_others`)."""
    past_px: int = 0
    """Holes whose surface no source camera sees now and one saw earlier (`psnr_past`)."""
    only_past_px: int = 0
    """Those of `past_px` that no other camera sees now either."""
    psnr_whole: float
    psnr_whole_rendered: float
    """`psnr_whole` of the view before inpainting."""
    psnr_subject: float | None = None
    """PSNR inside the true mask."""
    psnr_valid: float | None = None
    """PSNR over the pixels of the proxy that a source view colours."""
    psnr_holes: float | None = None
    psnr_holes_fg: float | None = None
    psnr_masked: float | None = None
    psnr_sources: float | None = None
    """PSNR over the holes whose surface a source view sees now."""
    psnr_others: float | None = None
    """PSNR over the holes whose surface no source view sees now, but another camera of the rig does."""
    psnr_past: float | None = None
    """PSNR over the holes whose surface no source view sees now and one saw earlier in the window."""
    ssim_whole: float | None = None
    ssim_holes: float | None = None
    ssim_holes_fg: float | None = None
    ssim_masked: float | None = None
    lpips_alex_whole: float | None = None
    lpips_alex_holes: float | None = None
    lpips_alex_holes_fg: float | None = None
    lpips_alex_masked: float | None = None
    lpips_alex_subject: float | None = None
    """Mean of the map inside the true mask."""
    lpips_vgg_whole: float | None = None
    lpips_vgg_holes: float | None = None
    lpips_vgg_holes_fg: float | None = None
    lpips_vgg_masked: float | None = None
    lpips_vgg_subject: float | None = None
    alpha_iou: float | None = None
    """IoU of the true mask and alpha above one half (M for an inpainter without alpha)."""
    hull_iou: float | None = None
    """IoU of the true mask and the proxy."""
    flicker: float | None = None
    """Change of the error since the previous frame along the surface's true motion, over the holes;
    0 for the truth."""
    flicker_whole: float | None = None
    """The same over the subject and the proxy; compare with the method `unfilled`, which shows the
    rendered view."""
    change_still: float | None = None
    """Change since the previous frame where the truth is still (`STILL`); needs no true motion."""

    @property
    def image_px(self) -> int:
        """Pixels of the image."""
        return self.width_px * self.height_px


@dataclass(frozen=True)
class TrueView:
    """The target of a completed view."""

    rgb: Float[Tensor, "3 height width"]
    """Colours in [0, 1], on the background of the `Scorers`."""
    mask: Bool[Tensor, "height width"]
    backward_flow_px: Float[Tensor, "height width 2"] | None = None
    """Position of each pixel's surface point in the previous true image; None if unknown."""
    origins: PixelOrigins | None = None
    """What shows the surface in each pixel (`SurfaceSeen.origins`); None if unknown."""


@dataclass(frozen=True)
class PreviousView:
    """The previous frame of a stream."""

    rgb: Float[Tensor, "3 height width"]
    truth: Float[Tensor, "3 height width"]


def true_view(
    frame: MultiViewFrame,
    background: Background = "black",
    backward_flow_px: Float[Tensor, "height width 2"] | None = None,
    origins: PixelOrigins | None = None,
) -> TrueView:
    """The image of a camera (a frame of one view with a mask), composited on a background by its mask."""
    assert frame.mask is not None, "held-out cameras have masks"
    rgb = camera_image(frame, background)
    return TrueView(rgb, frame.mask[0] > FOREGROUND, backward_flow_px, origins)


def score_view(
    completed: CompletedView, truth: TrueView, scorers: Scorers, previous: PreviousView | None = None
) -> ViewScores:
    """All scores of one completed view; the temporal ones need the previous frame."""
    view = completed.view
    background = scorers.background
    rgb = composite(background, completed.rgb, completed.opacity).clamp(0, 1)  # as it is shown
    rendered = composite(background, view.cut_rgb, view.silhouette).clamp(0, 1)
    hull = view.mask > 0.5
    holes = view.holes
    height, width = holes.shape
    whole = psnr(rgb, truth.rgb)
    whole_rendered = psnr(rendered, truth.rgb)
    assert whole is not None and whole_rendered is not None, "images have pixels"
    maps = {"lpips_alex": scorers.lpips_alex, "lpips_vgg": scorers.lpips_vgg}
    maps["ssim"] = None if scorers.ssim is None else partial(ssim_map, window=scorers.ssim)
    by_map: dict[str, Any] = {}
    for name, score in maps.items():
        if score is not None:
            by_map.update(_readings(name, score, rgb, truth, holes))
    return ViewScores(
        time=view.time,
        width_px=width,
        height_px=height,
        hull_px=int(hull.sum()),
        hole_px=int(holes.sum()),
        hole_fg_px=int((holes & truth.mask).sum()),
        psnr_whole=whole,
        psnr_whole_rendered=whole_rendered,
        psnr_subject=psnr(rgb, truth.rgb, truth.mask),
        psnr_valid=psnr(rgb, truth.rgb, hull & ~holes),
        psnr_holes=psnr(rgb, truth.rgb, holes),
        psnr_holes_fg=psnr(rgb, truth.rgb, holes & truth.mask),
        psnr_masked=psnr(rgb * holes, truth.rgb * holes) if bool(holes.any()) else None,
        alpha_iou=mask_iou(completed.opacity > 0.5, truth.mask),
        hull_iou=mask_iou(hull, truth.mask),
        **by_map,
        **({} if truth.origins is None else _by_origin(rgb, truth.rgb, holes, truth.origins)),
        **({} if previous is None else _temporal(rgb, view, truth, previous)),
    )


def _by_origin(
    rgb: Float[Tensor, "3 height width"],
    truth: Float[Tensor, "3 height width"],
    holes: Bool[Tensor, "height width"],
    origins: PixelOrigins,
) -> dict[str, Any]:
    """PSNR and numbers of the holes by what shows their surface."""
    found: dict[str, Any] = {"only_past_px": int((holes & origins.past).sum())}
    for name, seen in (
        ("sources", origins.sources),
        ("others", origins.others),
        ("past", origins.sources_past),
    ):
        found[f"{name}_px"] = int((holes & seen).sum())
        found[f"psnr_{name}"] = psnr(rgb, truth, holes & seen)
    return found


def mean_over_frames(values: Sequence[float | None], pixels: Sequence[int] | None = None) -> float | None:
    """Mean of the frames that have a value; None if none has.

    With `pixels`, the number of pixels behind each value, frames with fewer than `MIN_HOLE_PX`
    count only if all are.
    """
    there = [(v, n) for v, n in zip(values, pixels or [0] * len(values), strict=True) if v is not None]
    enough = [v for v, n in there if n >= MIN_HOLE_PX] or [v for v, _ in there]
    return sum(enough) / len(enough) if enough else None


def _readings(
    name: str,
    score: ScoreMap,
    rgb: Float[Tensor, "3 height width"],
    truth: TrueView,
    holes: Bool[Tensor, "height width"],
) -> dict[str, Any]:
    """The readings of a score that has a map; NaN values of the map do not count."""
    scored = score(rgb, truth.rgb)
    if scored is None:
        return {}
    masked = score(rgb * holes, truth.rgb * holes) if bool(holes.any()) else None
    maps = {"whole": scored, "holes": scored[holes], "holes_fg": scored[holes & truth.mask], "masked": masked}
    if name != "ssim":
        maps["subject"] = scored[truth.mask]
    finite = {region: values[values.isfinite()] for region, values in maps.items() if values is not None}
    return {f"{name}_{region}": float(own.double().mean()) for region, own in finite.items() if own.numel()}


def _temporal(
    now: Float[Tensor, "3 height width"], view: IncompleteView, truth: TrueView, previous: PreviousView
) -> dict[str, Any]:
    then = previous.rgb
    true_now = truth.rgb
    true_then = previous.truth
    shown = (view.mask > 0) | truth.mask
    still = shown & ((true_now - true_then).abs().amax(0) < STILL)
    found = {"change_still": change(now, then, still, MIN_HOLE_PX)}
    flow = truth.backward_flow_px
    if flow is not None:
        found["flicker_whole"] = warp_error(now - true_now, then - true_then, flow, shown)
        found["flicker"] = warp_error(now - true_now, then - true_then, flow, view.holes, MIN_HOLE_PX)
    return found


class VideoFeatures:
    """Cuts a stream into videos and computes their features for VFID."""

    def __init__(self, network: I3d | None) -> None:
        self.network = network
        self._frames: list[tuple[Tensor, Tensor]] = []
        self._found: dict[str, list[Tensor]] = {kind: [] for kind in KINDS}

    def add(self, rgb: Float[Tensor, "3 height width"], holes: Bool[Tensor, "height width"]) -> None:
        """Add the next frame."""
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
        assert self.network is not None, "frames are kept only for the network"
        for mode in MODES:
            for kind, frames in zip(("whole", "masked"), zip(*self._frames, strict=True), strict=True):
                self._found[f"{kind}_{mode}"].append(video_features(self.network, frames, mode))
        self._frames = []
