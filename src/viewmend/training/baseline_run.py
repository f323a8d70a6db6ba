"""Fine-tuning of the published networks: the same samples and the same loop as ours, their authors' parameters."""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn

from viewmend.atomic_writes import write_tensors, write_text
from viewmend.backgrounds import Background
from viewmend.baselines.e2fgvi import E2FGVI
from viewmend.baselines.frame_coder import SLOPE
from viewmend.baselines.published import NETWORKS, TRAINED
from viewmend.baselines.token_transformer import NATIVE_PX, TokenTransformer
from viewmend.training.adversary import BETAS, Adversary
from viewmend.training.baseline_objective import BaselineObjective, BaselineOutput
from viewmend.training.loop import Run
from viewmend.training.model_card import model_card
from viewmend.training.objective import StepOutput
from viewmend.training.plan import DataPlan, LossWeights, Recipe

CLIP_LENGTH = 5
"""Consecutive views in the authors' training clips."""
FULL_RATE = 0.8
"""Share of a run at the full learning rate; the rest is at a tenth."""


@dataclass(frozen=True, kw_only=True)
class BaselineRecipe(Recipe):
    """A run that trains a network of `NETWORKS`, named as it is. Its `part` and our terms of the loss say nothing."""

    model: None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Nothing of ours."""
    size_px: tuple[int, int] = NATIVE_PX
    """Height and width of the frames that it is trained on."""
    background: Background = "black"
    """What its views are upon, as the paper's are upon white."""
    started: bool = False
    """Whether it began with a checkpoint; E2FGVI's flow is only compared then, with the checkpoint's."""


def baseline_recipe(network: str, data: DataPlan, started: bool = False) -> BaselineRecipe:
    """The authors' parameters: Adam with betas (0, 0.99), 1e-4 for both networks, hinge of T-PatchGAN with 0.01.

    Theirs too: a tenth of the rate in the last fifth, neither warm-up nor clipping nor averaging. What the hardware
    sets is not: steps, and the batch (theirs is 8).
    """
    clip_length = data.clip_length if data.clip_length > 1 else CLIP_LENGTH
    return BaselineRecipe(
        name=network,
        data=replace(data, clip_length=clip_length, times=(0, *range(10, 10 + clip_length)), ray_views=0),
        loss=LossWeights(adversarial=0.01, adversarial_kind="hinge", discriminator="clip"),
        steps=2000,
        minutes=40.0,
        batch=8,
        new_per_batch=1,
        replay_size=32,
        learning_rate=1e-4,
        discriminator_rate=1e-4,
        warmup=1,
        weight_decay=0.0,
        max_grad_norm=1e6,
        ema=0.0,
        bfloat16=False,
        validate_every=0,
        started=started,
    )


class BaselineRun(Run):
    """A run of a `BaselineRecipe` from the network `start`; its model.safetensors has the official keys."""

    recipe: BaselineRecipe

    def _make_model(self, start: nn.Module | None) -> nn.Module:
        network = NETWORKS[self.recipe.name]()
        network.check_size(*self.recipe.size_px)
        if start is not None:
            network.load_state_dict(start.state_dict())
        else:
            _draw_as_he(network)
        return network.train()

    def _make_objective(self, start: nn.Module | None) -> nn.Module:
        assert isinstance(self.model, TokenTransformer | E2FGVI)
        return BaselineObjective(self.model, self.recipe.size_px, self.recipe.bfloat16, start, self.recipe.background)

    def _make_optimizer(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.learned, lr=self.recipe.learning_rate, betas=BETAS)

    def _make_validation(self) -> None:
        raise ValueError(f"expected --validate-every 0 for {self.recipe.name}, whose views `evaluate` judges")

    def _rate_factor(self, step: int, progress: float) -> float:
        return 1.0 if progress < FULL_RATE else 0.1

    def _judge(self, adversary: Adversary, batch: list[Any], output: StepOutput, weight: float):
        assert isinstance(output, BaselineOutput)
        truth = [(clip.truth.transpose(0, 1) + 1) / 2 for clip in output.clips]
        made = [(images.transpose(0, 1) + 1) / 2 for images in output.composed]
        return adversary.judge_images(truth, made, [clip.holes.float() for clip in output.clips], weight)

    def _write_model(self) -> None:
        write_tensors(self.out / TRAINED, self.averaged.state_dict(), {"format": "pt", "network": self.recipe.name})
        begun = "a checkpoint, whose licence goes on" if self.recipe.started else "random weights"
        said = (
            f"\nViews upon {self.recipe.background}. Began with {begun}. A method: {self.recipe.name}-o-def@FOLDER.\n"
        )
        write_text(self.out / "README.md", model_card(self.recipe, self.state) + said)


def _draw_as_he(network: TokenTransformer | E2FGVI) -> None:
    """Draws the convolutions before and after the tokens by their fan-in (He et al. 2015), all but the last.

    The authors draw N(0, 0.02). From there, where most of a frame is black, a network becomes black within tens of
    steps and stays so for hundreds: before its features say anything, tanh has no slope left.
    """
    parts = [child for name, child in network.named_children() if name in ("encoder", "hier_enc", "decoder")]
    convolutions = [m for part in parts for m in part.modules() if isinstance(m, nn.Conv2d)]
    for layer in convolutions[:-1]:
        nn.init.kaiming_normal_(layer.weight, SLOPE)
