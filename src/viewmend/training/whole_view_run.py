"""Training the reader of whole views: the same loop, windows of stored scenes, scores of whole views."""

from dataclasses import replace
from itertools import count, islice
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from viewmend.inpainting.checkpoint import save_inpainter
from viewmend.inpainting.sweep.cells import rim_depth, scattered
from viewmend.inpainting.sweep.error_net import faded
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.metrics.image_quality import psnr
from viewmend.training.loop import Run, fitting_weights
from viewmend.training.model_card import model_card
from viewmend.training.plan import WholeViewRecipe
from viewmend.training.scenes import StudioScenes
from viewmend.training.stored_scenes import StoredSamples, StudioStore
from viewmend.training.validation import SHOWN, WholeViewScores, write_picture
from viewmend.training.whole_view_objective import WholeViewObjective
from viewmend.training.whole_views import WholeView, WholeViewScenes, untrained

WRONG_FRACTION = 0.15
"""Part of the proxy that the rule `wrong` may have read."""


class WholeViewRun(Run):
    """A run of a `WholeViewRecipe`."""

    recipe: WholeViewRecipe

    def _make_model(self, start: nn.Module | None) -> nn.Module:
        model = untrained(self.recipe)
        if start is not None:
            fitting = fitting_weights(model, start)
            own = [name for name in model.state_dict() if not name.startswith(("coarse.", "errors."))]
            if absent := [name for name in own if name not in fitting]:
                raise ValueError(
                    f"expected a reader of whole views of the recipe's sizes to begin with, got none of {absent[0]}; "
                    "begin without, or choose another model"
                )
            errors = {name: weight for name, weight in fitting.items() if name.startswith("errors.")}
            model.load_state_dict(model.state_dict() | {name: fitting[name] for name in own} | errors)
        if self.recipe.part == "errors":
            if model.errors is None or start is None:
                raise ValueError(
                    "expected a trained reader and an ErrorNet to train alone, got none; give --from and "
                    "--model.error-features 24"
                )
            model.requires_grad_(False)
            model.errors.requires_grad_(True)
        return model.train()

    def _make_objective(self, start: nn.Module | None) -> nn.Module:
        assert isinstance(self.model, SweepNet)
        return WholeViewObjective(self.model, self.recipe.view_loss)

    def _make_validation(self) -> "WholeViewValidation":  # pyright: ignore[reportIncompatibleMethodOverride]
        return WholeViewValidation(self.recipe, self.out)

    def _write_model(self) -> None:
        assert isinstance(self.averaged, SweepNet)
        save_inpainter(self.averaged, self.out, model_card(self.recipe, self.state))


class WholeViewValidation:
    """Views of procedural people that training never sees, made when they are first asked for."""

    def __init__(self, recipe: WholeViewRecipe, folder: Path) -> None:
        """Pictures go to `folder`, one after each validation: validation-000500.png."""
        self.recipe = recipe
        self.folder = folder
        self._views: list[WholeView] = []

    @torch.no_grad()
    def judge(self, model: nn.Module, step: int) -> WholeViewScores:
        """Read every view, score it, and leave a picture of the first few."""
        assert isinstance(model, SweepNet)
        self._views = self._views or self._made()
        scores, shown = [], []
        for own in self._views:
            own = own.to(next(model.parameters()).device)
            view, truth = own.view, own.truth / 255
            reading = model(view, own.rig, own.scale, guess=own.guess)
            rgb = scattered(reading.rgb, reading.pixels, view.mask.shape)
            subject, holes = own.alpha > 127, (view.mask > 0) & (view.weights.sum(0) == 0)
            ways = [(view.rgb, None), (rgb, None), (rgb, subject), (rgb, holes)]
            if model.errors is not None:
                around = (rim_depth(view.depth) > 0).to(view.error)
                part = faded(replace(view, error=around), model.errors(view, own.rig, own.scale), WRONG_FRACTION)
                ways.append((torch.where(part.read, rgb, (1 - part.error) * view.rgb), None))
            scores.append([_psnr(image, truth, where) for image, where in ways])
            shown.append(torch.cat([view.rgb, rgb, truth], 2))
        write_picture(shown[:SHOWN], self.folder / f"validation-{step:06d}.png")
        return WholeViewScores(step, *torch.tensor(scores).nanmean(0).tolist())

    def _made(self) -> list[WholeView]:
        plan = replace(self.recipe.data, held_cameras=1, performers=None, motions=None, data_device="cpu")
        store = StudioStore(StudioScenes(plan, "validation", "validation"))
        scenes = WholeViewScenes(
            StoredSamples(store, plan, "validation"), "validation", untrained(self.recipe), quick=0.0
        )
        made = (view for number in count() for view in scenes.scene(number))
        return list(islice(made, self.recipe.validation_views))


def _psnr(
    image: Float[Tensor, "3 height width"],
    truth: Float[Tensor, "3 height width"],
    where: Bool[Tensor, "height width"] | None,
) -> float:
    """NaN where there are no such pixels."""
    score = psnr(image, truth, torch.ones_like(truth[0], dtype=torch.bool) if where is None else where)
    return float("nan") if score is None else score
