"""Views with all that the reader of whole views needs, and windows of them to learn from. Ours."""

from dataclasses import dataclass, replace
from random import Random

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.network import set_compute_dtype
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.sweep.cells import rim_depth
from viewmend.inpainting.sweep.lookup import Scale
from viewmend.inpainting.sweep.pyramids import Rig
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.rendering.crop import Crop, subject_crop
from viewmend.training.plan import WholeViewRecipe
from viewmend.training.samples import Sample, to_device
from viewmend.training.scenes import SceneSource
from viewmend.views import IncompleteView

WINDOW_PX = 112
"""Side of the windows that are learned from."""
MARGIN_PX = 16
"""What is kept around the subject."""
WRONG = 0.08
"""A pixel is wrong where a channel is so far off, in [0, 1]."""
DARKEST = 0.6
"""Least of the gains of augmented colours."""
LEAST_PX = 200
"""Views of a smaller subject are passed over."""
FEWEST_CAMERAS = 3
"""At least so many cameras are shown, where there are more."""
BLINDED, SPARSE, RECOLOURED, QUICK = 0.6, 0.3, 0.7, 0.3
"""Fractions: windows with fewer cameras, windows of which only a part is read, views with other colours, views whose
holes are guessed from their surroundings alone."""


@dataclass(frozen=True)
class WholeView:
    """The subject's part of a rendered view, its cameras in all scales, and the truth."""

    view: IncompleteView
    rig: Rig
    scale: Scale
    guess: Float[Tensor, "3 height width"]
    """`SweepNet.coarse_guess` of the whole view."""
    truth: UInt8[Tensor, "3 height width"]
    """F*, background black."""
    alpha: UInt8[Tensor, "height width"]
    """How much of each pixel the subject covers, in 255ths."""
    depth: Float[Tensor, "height width"]
    """True z-depth, metres, 0 where there is no surface."""

    @classmethod
    def of(cls, sample: Sample, net: SweepNet, quick: bool = False) -> "WholeView":
        """A sample that knows alpha and depth, and the cameras near it; `net` makes the guess, or a quick one."""
        assert sample.ray_views and sample.alpha is not None and sample.depth is not None, "a stored scene's"
        view, truth, alpha, depth = sample.view, sample.truth, sample.alpha, sample.depth
        scale, rig = Scale.of(view), Rig.of(sample.ray_views, view.silhouettes)
        crop = subject_crop(view, MARGIN_PX)
        if crop is not None:
            view = crop.of_view(view)
            truth, alpha, depth = (crop.of_image(image).contiguous() for image in (truth, alpha, depth))
        return cls(view, rig, scale, net.coarse_guess(view, rig.views, quick), truth, alpha, depth)

    def to(self, device: torch.device | str) -> "WholeView":
        """The same on `device`."""
        return to_device(self, device)

    def part(self, crop: Crop) -> "WholeView":
        """A part of the view, with the same cameras."""
        guess, truth, alpha, depth = (crop.of_image(i) for i in (self.guess, self.truth, self.alpha, self.depth))
        return replace(self, view=crop.of_view(self.view), guess=guess, truth=truth, alpha=alpha, depth=depth)

    @property
    def wrong(self) -> Bool[Tensor, "height width"]:
        """Which pixels of the proxy and its rim show another colour than they should."""
        return ((self.view.rgb - self.truth / 255).abs().amax(0) > WRONG) & (rim_depth(self.view.depth) > 0)


class WholeViewScenes:
    """A source's samples as whole views, most with other colours; the same for the same number."""

    def __init__(self, scenes: SceneSource[Sample], seed: str, net: SweepNet, quick: float = QUICK) -> None:
        """`net` makes the guesses, this fraction of them quick ones."""
        self.scenes = scenes
        self.seed = seed
        self.net = net
        self.quick = quick

    def scene(self, number: int) -> list[WholeView]:
        """Views of scene `number` that show anything."""
        random, guesses = (Random(f"{self.seed}/{kind}/{number}") for kind in ("colours", "guesses"))
        samples = [s for s in self.scenes.scene(number) if int((s.view.mask > 0).sum()) >= LEAST_PX]
        shown = [recoloured(s, random) if random.random() < RECOLOURED else s for s in samples]
        return [WholeView.of(s, self.net, guesses.random() < self.quick) for s in shown]


def untrained(recipe: WholeViewRecipe) -> SweepNet:
    """The recipe's net before it learns anything; its `RayBlendNet` is that of a checkpoint.

    Raises:
        WeightsError: there is no such checkpoint.
        ValueError: it has no `RayBlendNet`, or one of other sizes.
    """
    net = SweepNet(recipe.model)
    if recipe.model.coarse_fill == "rays":
        filled = load_network(recipe.coarse_from)
        weights = net.coarse.state_dict()
        found = {} if isinstance(filled, PatchTransformer) else filled.coarse.state_dict()
        if {k: v.shape for k, v in found.items()} != {k: v.shape for k, v in weights.items()}:
            raise ValueError(
                f"expected a model with a RayBlendNet to fill holes, got '{recipe.coarse_from}' without one that fits; "
                "name another by --coarse-from, or give --model.coarse-fill smooth"
            )
        net.coarse.load_state_dict(found)
    set_compute_dtype(net, torch.bfloat16 if recipe.bfloat16 else torch.float32)
    return net


def recoloured(sample: Sample, random: Random) -> Sample:
    """The sample with channels that changed places, and everything darker."""
    assert sample.ray_views is not None, "a stored scene's"
    channels, gain = random.sample(range(3), 3), random.uniform(DARKEST, 1)
    frame = sample.ray_views.frame
    rgb, truth = (
        (gain * image.float()).round().to(torch.uint8) for image in (frame.rgb[:, channels], sample.truth[channels])
    )
    view = replace(sample.view, rgb=gain * sample.view.rgb[channels])
    return replace(sample, view=view, ray_views=replace(sample.ray_views, frame=replace(frame, rgb=rgb)), truth=truth)


def random_window(whole: WholeView) -> WholeView:
    """A window of the view, half of them about a wrong pixel; mostly with fewer cameras."""
    wrong = torch.nonzero(whole.wrong)
    some = wrong if len(wrong) and bool(torch.rand(()) < 0.5) else torch.nonzero(whole.view.mask > 0)
    height, width = whole.view.mask.shape
    row, column = some[int(torch.randint(len(some), ()))].tolist()
    top, bottom = _side(row, height)
    left, right = _side(column, width)
    window = whole.part(Crop(left, top, right, bottom))
    count = len(whole.rig.pyramids)
    if count > FEWEST_CAMERAS and bool(torch.rand(()) < BLINDED):
        window = replace(window, rig=whole.rig.first(int(torch.randint(FEWEST_CAMERAS, count, ()))))
    return window


def random_part(window: WholeView) -> Bool[Tensor, "height width"] | None:
    """Which pixels are read: sometimes those about wrong ones alone, as an error rule would ask; None for all."""
    if float(torch.rand(())) > SPARSE:
        return None
    by_chance = torch.rand(window.view.mask.shape) < 0.01 * float(torch.rand(()))
    around = int(torch.randint(5, ()))
    some = (window.wrong | window.view.holes | by_chance).float()
    read = (F.max_pool2d(some[None], 2 * around + 1, 1, around)[0] > 0) & (rim_depth(window.view.depth) > 0)
    return read if bool(read.any()) else None


def _side(at: int, size: int) -> tuple[int, int]:
    """First pixel and the one after the last of a window about a pixel, even, within the image."""
    if size <= WINDOW_PX:
        return 0, size
    first = at - int(torch.randint(WINDOW_PX, ()))
    first = min(max(0, first), size - WINDOW_PX) // 2 * 2
    return first, first + WINDOW_PX
