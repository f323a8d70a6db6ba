"""The averaged weights on fixed views that training never sees: scores, and pictures to look at."""

from dataclasses import dataclass, replace
from itertools import count, islice
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.backgrounds import Background
from viewmend.baselines.classical import Telea
from viewmend.capture.images import write_image
from viewmend.inpainting.protocol import ContextProvider, State, shown_upon
from viewmend.inpainting.upon_white import fill_upon
from viewmend.metrics.image_quality import psnr
from viewmend.training.plan import Recipe
from viewmend.training.samples import Sample
from viewmend.training.sources import scene_source
from viewmend.training.true_images import true_image

SHOWN = 8
"""Views in the picture."""
TILE_PX = 256


@dataclass(frozen=True)
class ValidationScores:
    """Means over the views, in dB."""

    step: int
    holes: float
    """PSNR in the holes."""
    telea: float
    """What Telea scores there."""
    coarse_fill: float
    """What the coarse fill scores, before any patch."""


@dataclass(frozen=True)
class WholeViewScores:
    """Means over the validation's views, PSNR in dB: of the subject's box, upon black."""

    step: int
    rendered: float
    """As the source views show it."""
    read: float
    """With every pixel of the proxy read."""
    subject: float
    """The same, within the true silhouette."""
    holes: float
    """The same, where no source view has a colour."""
    wrong: float | None = None
    """With a small part read of what an `ErrorNet` takes for wrong."""


class Validation:
    """Fixed views of a recipe's kind of data, made when they are first asked for."""

    def __init__(self, recipe: Recipe, folder: Path) -> None:
        """Pictures go to `folder`, one after each validation: validation-000500.png."""
        self.recipe = recipe
        self.folder = folder
        self._samples: list[Sample] = []
        self._telea: list[float] = []

    @torch.no_grad()
    def judge(self, model: nn.Module, step: int) -> ValidationScores:
        """Mend every view, score it, and leave a picture of the first few."""
        background = shown_upon(model)
        if not self._samples:
            self._samples = self._views()
            self._telea = [_telea(sample, background) for sample in self._samples]
        training = model.training
        model.eval()
        device = next(model.parameters()).device
        ours, fills, shown = [], [], []
        for sample in self._samples:
            on_device = sample.to(device)
            made = model([on_device.view], [list(on_device.context)], ray_views=[on_device.ray_views])[0]
            completed, truth = made.upon_own.float().clamp(0, 1).cpu(), true_image(sample, background)
            ours.append(_score(completed, truth, sample))
            filled = torch.where(sample.view.error > 0, made.coarse.float().cpu(), completed)
            fills.append(_score(filled, truth, sample))
            shown.append(torch.cat([sample.view.rgb, completed, truth], 2))
        model.train(training)
        write_picture(shown[:SHOWN], self.folder / f"validation-{step:06d}.png")
        return ValidationScores(step, *(sum(x) / len(x) for x in (ours, self._telea, fills)))

    def _views(self) -> list[Sample]:
        # One view a scene and no clips: more scenes say more.
        plan = replace(self.recipe.data, held_cameras=1, targets_per_camera=1, clip_length=1, data_device="cpu")
        scenes = scene_source(plan, "validation", "validation")
        samples = (sample for number in count() for sample in scenes.scene(number))
        return list(islice(samples, self.recipe.validation_views))


def _telea(sample: Sample, background: Background) -> float:
    """What Telea scores upon the model's background."""
    fill = fill_upon(Telea(), background)
    rgb = fill.step(sample.view, ContextProvider(lambda *_: None), State())[0].rgb
    return _score(rgb, true_image(sample, background), sample)


def _score(rgb: Float[Tensor, "3 height width"], truth: Float[Tensor, "3 height width"], sample: Sample) -> float:
    score = psnr(rgb, truth, sample.view.error > 0)
    assert score is not None, "samples have holes"
    return score


def write_picture(rows: list[Float[Tensor, "3 _h _w"]], path: Path) -> None:
    """Writes `picture`."""
    write_image(path, picture(rows).permute(1, 2, 0).contiguous().numpy())


def picture(rows: list[Float[Tensor, "3 _h _w"]]) -> UInt8[Tensor, "3 height width"]:
    """Rows of rendered, mended and true images, all reduced to one size."""
    same = [F.interpolate(r[None], (TILE_PX, 3 * TILE_PX), mode="bilinear", antialias=True)[0] for r in rows]
    return (torch.cat(same, 1).clamp(0, 1) * 255).round().to(torch.uint8)
