"""The paper's model: from an incomplete view and its context to a complete view (sections 1, 2, 7 and 9)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.models.base import ContextProvider, State
from viewmend.models.compositing import blend, painted_alpha
from viewmend.models.network import Network
from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.context import Batch, ContextFrame, Target, collate, window_times
from viewmend.models.paper.patches import STEP_PX, any_in_patch, centers_px, lift, merge, patch_depths
from viewmend.models.paper.tokenizer import (
    Decoder,
    EncoderInput,
    Tokeniser,
    build_context_input,
    build_target_input,
)
from viewmend.models.paper.transformer import Transformer
from viewmend.types import CompletedView, ContextViews, IncompleteView

Contexts = Sequence[Sequence[ContextFrame | ContextViews]]
"""Encoded frames and camera images of each view."""


@dataclass(frozen=True)
class Prediction:
    """The model's output for one view. RGB is approximately in [0, 1] but not clamped."""

    inpainted: Float[Tensor, "3 height width"]
    """Ftilde: the decoded patches, blended; 0 where none covers a pixel."""
    coverage: Float[Tensor, "height width"]
    """1 where a decoded patch covers the pixel, else 0."""
    completed: Float[Tensor, "3 height width"]
    """Fhat = E Ftilde + (1 - E) F, with F on black. Bit-identical to F where E is 0."""
    alpha: Float[Tensor, "height width"] | None
    """Alpha of a view painted on white: M, and 1 on all of E. None for a model on black, where alpha is M."""
    target_mask: Float[Tensor, "height width"] | None = None
    """M_t, by which Fhat is yet to be composited; None if it is not known."""

    @property
    def composited(self) -> Float[Tensor, "3 height width"]:
        """Fhat on the model's background, composited by M_t."""
        own = self.completed if self.alpha is None else self.completed + (1 - self.alpha)
        if self.target_mask is None:
            return own
        behind = 0 if self.alpha is None else 1 - self.target_mask
        return own * self.target_mask + behind


class PatchTransformer(Network):
    """T(F[t] | G[t], I[i, tau]) of section 1. It is stateless: the context provider caches encoded camera images."""

    config: PaperConfig

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        self.config = config
        self.background = config.background
        self.needs_mask = config.use_mask
        self.window_frames = max(config.n_c, config.k_w * config.n_w)
        self.tokeniser = Tokeniser(config)
        self.transformer = Transformer(config)
        self.decoder = Decoder(config)

    def forward(
        self, views: Sequence[IncompleteView], contexts: Contexts, top_k: int | None = None
    ) -> list[Prediction]:
        """One prediction per view of any size, each from its own context. Gradients reach every parameter.

        Camera images are encoded here in one batch; those of frames and cameras outside the view's
        window are ignored, as in `step`. Pruning keeps `top_k` context tokens; None for the
        config's. Raises ValueError if the numbers of views and contexts differ.
        """
        if len(views) != len(contexts):
            raise ValueError(
                f"expected one context per view, got {len(views)} views and {len(contexts)} contexts"
            )
        frames = self.encode_windows(views, contexts)
        targets = self.encode_targets(views)
        missing = [i for i, target in enumerate(targets) if bool(target.incomplete.any())]
        patches: dict[int, Tensor] = {}
        if missing:
            batch = self.collate([targets[i] for i in missing], [frames[i] for i in missing])
            decoded = self.decode(batch, self.config.top_k if top_k is None else top_k)
            patches = dict(zip(missing, decoded, strict=True))
        return [self._predict(target, patches.get(i)) for i, target in enumerate(targets)]

    @torch.no_grad()
    def step(
        self, view: IncompleteView, context: ContextProvider, state: State
    ) -> tuple[CompletedView, State]:
        """Complete a view from the cameras and frames of its window (section 9); unchanged if it has no holes."""
        if not bool((view.error > 0).any()):
            return CompletedView(view, view.rgb), state
        times = window_times(view.time, self.config)[: context.quality.context_times]
        frames = self._encoded(times, self.source_names(view), context)
        prediction = self([view], [frames], context.quality.top_k)[0]
        return CompletedView(view, prediction.completed.clamp(0, 1), prediction.alpha), state

    @torch.no_grad()
    def encode_history(self, view: IncompleteView, context: ContextProvider) -> None:
        """Encode the view's cameras at the earlier frames of its window."""
        if bool((view.error > 0).any()):
            self._encoded(window_times(view.time, self.config)[1:], self.source_names(view), context)

    @torch.no_grad()
    def encode_cameras(self, views: ContextViews, context: ContextProvider) -> None:
        """Encode all of these cameras at their frame."""
        self._encoded((views.frame.time,), views.frame.cameras.names, context)

    def _encoded(
        self, times: Sequence[int], names: Sequence[str], context: ContextProvider
    ) -> list[ContextFrame]:
        """These cameras in these frames, encoded now or for an earlier view."""
        return context.encoded(times, names, self.encode_contexts, self.encoding_kind)

    def source_names(self, view: IncompleteView) -> tuple[str, ...]:
        """Names of the cameras in a view's context, the closest first (section 2)."""
        return view.closest_views(self.config.num_source_views)

    def encode_windows(self, views: Sequence[IncompleteView], contexts: Contexts) -> list[list[ContextFrame]]:
        """The views' contexts, with all camera images of their windows (section 2) encoded in one batch."""
        windows = []
        for view, context in zip(views, contexts, strict=True):
            names = self.source_names(view)
            times = window_times(view.time, self.config)
            kept = [c for c in context if isinstance(c, ContextFrame) or c.frame.time in times]
            kept = [
                c if isinstance(c, ContextFrame) or c.frame.cameras.names == names else c.select(names)
                for c in kept
            ]
            windows.append([c for c in kept if isinstance(c, ContextFrame) or len(c.frame.cameras)])
        images = [item for window in windows for item in window if isinstance(item, ContextViews)]
        encoded = iter(self.encode_contexts(images))
        return [
            [f for item in window for f in (next(encoded) if isinstance(item, ContextViews) else (item,))]
            for window in windows
        ]

    def encode_contexts(self, many: Sequence[ContextViews]) -> list[tuple[ContextFrame, ...]]:
        """One encoded frame per camera of each element, in order; all images in one batch (sections 3 to 5)."""
        if not many:
            return []
        stacks = [build_context_input(views, self.config) for views in many]
        with self.autocast():
            tokens = self.tokeniser(stacks)
            keys_values = self.transformer.project_context(tokens)
        counts = [len(stack.places) for stack in stacks]
        parts = zip(many, stacks, tokens.split(counts), keys_values.split(counts, 2), strict=True)
        return [_split_by_camera(*part) for part in parts]

    def encode_targets(self, views: Sequence[IncompleteView]) -> list[Target]:
        """Tokens of every kept patch of each view (sections 3 and 4)."""
        stacks = [build_target_input(view, self.config) for view in views]
        with self.autocast():
            tokens = self.tokeniser(stacks).split([len(stack.places) for stack in stacks])
        return [
            Target(view, stack.places, own, any_in_patch(view.missing[None] > 0).cpu()[stack.kept_on_host])
            for view, stack, own in zip(views, stacks, tokens, strict=True)
        ]

    def collate(self, targets: Sequence[Target], contexts: Sequence[Sequence[ContextFrame]]) -> Batch:
        """The transformer's input for targets with incomplete patches."""
        with self.autocast():
            own = [self.transformer.project_context(t.tokens[~t.incomplete]) for t in targets]
        return collate(targets, contexts, own, self.config)

    def decode(self, batch: Batch, top_k: int | None) -> list[Float[Tensor, "patch 3 28 28"]]:
        """RGB of each target's incomplete patches: transformer and decoder (sections 6 and 7)."""
        with self.autocast():
            tokens = self.transformer(batch.queries, batch.at, batch.keys_values, batch.context_at, top_k)
            decoded = self.decoder(
                torch.cat([own[:count] for own, count in zip(tokens, batch.counts, strict=True)])
            )
        return list(decoded.float().split(batch.counts))

    def _predict(self, target: Target, patches: Float[Tensor, "patch 3 28 28"] | None) -> Prediction:
        """The decoded patches merged, and the view completed (section 7); unchanged without patches."""
        view = target.view
        alpha = painted_alpha(view) if self.config.background == "white" else None
        if patches is None:
            zeros = torch.zeros_like(view.rgb)
            return Prediction(zeros, zeros[0], view.rgb, alpha, view.target_mask)
        height, width = view.mask.shape
        (inpainted,), (coverage,) = merge(
            patches, target.places[target.incomplete], (1, height, width), STEP_PX
        )
        completed = blend(view.rgb, view.error, inpainted, coverage, clamp=False)
        return Prediction(inpainted, coverage, completed, alpha, view.target_mask)


def _split_by_camera(
    views: ContextViews,
    images: EncoderInput,
    tokens: Float[Tensor, "patch dim"],
    keys_values: Float[Tensor, "block 2 patch dim"],
) -> tuple[ContextFrame, ...]:
    """The encoded patches of one frame, lifted (section 5) and split by camera."""
    cameras = views.frame.cameras
    places = images.places
    depths = patch_depths(views.depth, images.foreground)
    points, valid = lift(places, depths, cameras)
    uv_px = centers_px(places)
    frames = []
    first = 0
    for i, count in enumerate(images.kept.sum((1, 2)).tolist()):
        own = slice(first, first + count)
        frames.append(
            ContextFrame(
                camera=cameras[i],
                time=views.frame.time,
                places=places[own, 1:],
                uv_px=uv_px[own],
                points_world=points[own],
                valid=valid[own],
                depths=depths[i],
                # Copies, so that a frame does not keep the memory of the whole batch alive.
                tokens=tokens[own].clone(),
                keys_values=keys_values[:, :, own].clone(memory_format=torch.contiguous_format),
            )
        )
        first += count
    return tuple(frames)
