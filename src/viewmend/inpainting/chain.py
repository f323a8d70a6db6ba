"""A coarse fill, and the patch transformer upon it. Ours."""

from collections.abc import Sequence

import torch

from viewmend.backgrounds import Background
from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.context import ContextFrame
from viewmend.inpainting.correspondences import Correspondences
from viewmend.inpainting.network import Network
from viewmend.inpainting.patch_transformer import PatchTransformer, Prediction
from viewmend.inpainting.protocol import ContextProvider, RenderQuality, State
from viewmend.inpainting.ray_blend_net import RayBlendNet
from viewmend.views import CompletedView, ContextViews, IncompleteView


class Chain(Network):
    """Fills holes coarsely, by `RayBlendNet` or smoothly, and lets the patch transformer refine that."""

    def __init__(self, config: InpainterConfig) -> None:
        super().__init__()
        self.config = config
        self.patches = PatchTransformer(config)
        self.coarse = RayBlendNet(config.num_ray_views) if config.coarse_fill == "rays" else SmoothFill()

    @property
    def background(self) -> Background:
        """What it paints upon."""
        return self.patches.background

    def crop_margin_px(self, quality: RenderQuality) -> int | None:
        """The coarse fill's where it is alone; else the patch transformer's, which is wider."""
        return (self.coarse if quality.context_times == 0 else self.patches).crop_margin_px(quality)

    def forward(
        self,
        views: Sequence[IncompleteView],
        contexts: Sequence[Sequence[ContextFrame | ContextViews]],
        ray_views: Sequence[ContextViews | None] | None = None,
        top_k: int | None = None,
        matches: Sequence[Correspondences | None] = (),
    ) -> list[Prediction]:
        """One prediction per view. Gradients reach every parameter.

        Args:
            views: of any sizes.
            contexts: of each view, as in `PatchTransformer.refine`.
            ray_views: what the cameras close to each view see at its time, for `RayBlendNet`; None without.
            top_k: context tokens that survive pruning; None takes the config's.
            matches: as in `PatchTransformer.refine`.
        """
        coarse = self.coarse(views, ray_views or [None] * len(views))
        return self.patches.refine(views, coarse, contexts, top_k, matches)

    def encode_past(self, view: IncompleteView, context: ContextProvider) -> None:
        """The patch transformer's."""
        self.patches.encode_past(view, context)

    def encode_cameras(self, views: ContextViews, context: ContextProvider) -> None:
        """The patch transformer's."""
        self.patches.encode_cameras(views, context)

    @torch.no_grad()
    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """The completed view; the coarse fill alone where the quality allows no context times."""
        if context.quality.context_times == 0 or not bool((view.error > 0).any()):
            return self.coarse.step(view, context, state)
        coarse = self.coarse([view], [self.coarse.ray_views(view, context)])[0]
        return self.patches.complete(view, coarse, context), state


def build(config: InpainterConfig) -> Chain | PatchTransformer:
    """The networks of a config, untrained: a `Chain`, or the `PatchTransformer` alone where there is no coarse fill."""
    return PatchTransformer(config) if config.coarse_fill == "none" else Chain(config)
