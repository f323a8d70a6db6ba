"""The patch transformer: an incomplete view and its context to a complete view (sections 2 to 7 and 9)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.backgrounds import Background
from viewmend.inpainting.assembly import Target, assemble
from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.context import ContextFrame, window_times
from viewmend.inpainting.coordinates import lift, patch_depths
from viewmend.inpainting.correspondences import AttentionGuide, Correspondences, sought_keys
from viewmend.inpainting.decoder import Decoder, blend
from viewmend.inpainting.encoder import RECEPTIVE_RADIUS_PX
from viewmend.inpainting.identity_init import identity_init
from viewmend.inpainting.images import Images, Tokeniser, context_images, target_images
from viewmend.inpainting.network import Network
from viewmend.inpainting.patches import (
    PATCH_PX,
    STEP_PX,
    any_in_patch,
    centers_px,
    crop,
    grid_shape,
    merge,
    padded_size,
    split,
)
from viewmend.inpainting.protocol import ContextProvider, RenderQuality, State
from viewmend.inpainting.transformer import Transformer
from viewmend.inpainting.upon_white import covered
from viewmend.views import CompletedView, ContextViews, IncompleteView


@dataclass(frozen=True)
class Prediction:
    """What the networks made of one view."""

    inpainted: Float[Tensor, "3 height width"]
    """Ftilde: the decoded patches, blended; about [0, 1] but not clamped; 0 where not covered."""
    coverage: Float[Tensor, "height width"]
    """1 where a decoded patch covers the pixel, else 0."""
    coarse: Float[Tensor, "3 height width"]
    """The colours that the encoder was shown: the view's, its holes filled where there is a coarse fill."""
    completed: Float[Tensor, "3 height width"]
    """Fhat = E Ftilde + (1 - E) F, not clamped; F, upon black, bit for bit where E is 0."""
    alpha: Float[Tensor, "height width"] | None
    """What is not background of a view upon white: M, and all of E that was painted. None upon black, where it is M."""
    missed: Float[Tensor, ""] | None = None
    """How far attention is from true correspondences (`AttentionGuide.missed`); None without any."""

    @property
    def upon_own(self) -> Float[Tensor, "3 height width"]:
        """Fhat upon the background that the model paints on."""
        return self.completed if self.alpha is None else self.completed + (1 - self.alpha)


class PatchTransformer(Network):
    """T(F[t] | G[t], I[i, tau]) of section 1. Its state is empty: what it encodes, the context provider remembers."""

    context_gradients = 1.0
    """Share of the context images through whose encoding gradients flow, in training."""

    def __init__(self, config: InpainterConfig) -> None:
        super().__init__()
        self.config = config
        self.tokeniser = Tokeniser(config)
        self.transformer = Transformer(config)
        self.decoder = Decoder(config)
        if config.colour_skip and config.identity_init:
            identity_init(self.tokeniser.linear, self.decoder.linear, config)

    @property
    def background(self) -> Background:
        """What it paints upon."""
        return "white" if self.config.background == "white" else "black"

    def crop_margin_px(self, quality: RenderQuality) -> int | None:
        """How far around the subject a view matters to its result; None where the whole view's size does."""
        return PATCH_PX + RECEPTIVE_RADIUS_PX if self.config.rope_unit == "patch" else None

    def encode_contexts(self, many: Sequence[ContextViews]) -> list[tuple[ContextFrame, ...]]:
        """One frame per camera of each element (a time, a scene), in their order; all images in one batch."""
        if not many:
            return []
        stacks = [context_images(views, self.config) for views in many]
        with self.autocast():
            tokens = self.tokeniser(stacks, self.context_gradients)
            keys_values = self.transformer.project_context(tokens)
        counts = [len(stack.places) for stack in stacks]
        parts = zip(many, stacks, tokens.split(counts), keys_values.split(counts, 2), strict=True)
        return [_context_frames(*part, self.config.patch_depth == "centre") for part in parts]

    def forward(
        self,
        views: Sequence[IncompleteView],
        contexts: Sequence[Sequence[ContextFrame | ContextViews]],
        ray_views: Sequence[ContextViews | None] | None = None,
        top_k: int | None = None,
        matches: Sequence[Correspondences | None] = (),
    ) -> list[Prediction]:
        """`refine` upon the views as they are; `ray_views` are for those that look along rays, and not looked at."""
        return self.refine(views, [view.rgb for view in views], contexts, top_k, matches)

    def refine(
        self,
        views: Sequence[IncompleteView],
        coarse: Sequence[Float[Tensor, "3 _h _w"]],
        contexts: Sequence[Sequence[ContextFrame | ContextViews]],
        top_k: int | None = None,
        matches: Sequence[Correspondences | None] = (),
    ) -> list[Prediction]:
        """One prediction per view from its own context. Gradients reach every parameter.

        Args:
            views: of any sizes.
            coarse: the colours that the encoder is shown of each view: its own, or with holes filled.
            contexts: encoded frames of each view, any number, and camera images, which are encoded first, all in one
                batch. Images of times and cameras that `step` would not look at are passed over.
            top_k: context tokens that survive pruning; None takes the config's.
            matches: what attention should look at, of each view, or nothing.

        Raises:
            ValueError: there is not one context for each view.
        """
        if len(views) != len(contexts):
            raise ValueError(f"expected one context per view, got {len(views)} views and {len(contexts)} contexts")
        frames = self._encoded(views, contexts)
        targets = self._encode_targets(views, coarse)
        asking = [i for i, target in enumerate(targets) if bool(target.incomplete.any())]
        patches: dict[int, Tensor] = {}
        missed: dict[int, Tensor | None] = {}
        if asking:
            wanted = [matches[i] if matches else None for i in asking]
            decoded, found = self._decode([targets[i] for i in asking], [frames[i] for i in asking], top_k, wanted)
            patches, missed = dict(zip(asking, decoded, strict=True)), dict(zip(asking, found, strict=True))
        return [_prediction(target, patches.get(i), self.config, missed.get(i)) for i, target in enumerate(targets)]

    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """The completed view (section 9); a view without holes comes back at once."""
        return self.complete(view, view.rgb, context), state

    @torch.no_grad()
    def complete(
        self, view: IncompleteView, coarse: Float[Tensor, "3 height width"], context: ContextProvider
    ) -> CompletedView:
        """The view completed upon a coarse fill, from the cameras and times of its window."""
        if not bool((view.error > 0).any()):
            return CompletedView(view, view.rgb)
        times = window_times(view.time, self.config)[: context.quality.context_times]
        frames = context.encoded(times, self.context_names(view), self.encode_contexts)
        made = self.refine([view], [coarse], [frames], context.quality.top_k)[0]
        return CompletedView(view, made.completed.clamp(0, 1), made.alpha)

    @torch.no_grad()
    def encode_past(self, view: IncompleteView, context: ContextProvider) -> None:
        """Encodes the cameras of a view at the earlier times of its window."""
        if bool((view.error > 0).any()):
            times = window_times(view.time, self.config)[1:]
            context.encoded(times, self.context_names(view), self.encode_contexts)

    @torch.no_grad()
    def encode_cameras(self, views: ContextViews, context: ContextProvider) -> None:
        """Encodes all of these cameras at their time."""
        context.encoded((views.frame.time,), views.frame.cameras.names, self.encode_contexts)

    def context_names(self, view: IncompleteView) -> tuple[str, ...]:
        """The cameras that are context."""
        count = self.config.context_cameras
        return view.source_views if count is None else view.closest_views(count)

    def _encoded(
        self, views: Sequence[IncompleteView], contexts: Sequence[Sequence[ContextFrame | ContextViews]]
    ) -> list[list[ContextFrame]]:
        """The contexts, what of them is images encoded in one batch."""
        contexts = [self.looked_at(*own) for own in zip(views, contexts, strict=True)]
        images = [item for context in contexts for item in context if isinstance(item, ContextViews)]
        encoded = iter(self.encode_contexts(images))
        return [
            [f for item in context for f in (next(encoded) if isinstance(item, ContextViews) else (item,))]
            for context in contexts
        ]

    def looked_at(
        self, view: IncompleteView, context: Sequence[ContextFrame | ContextViews]
    ) -> list[ContextFrame | ContextViews]:
        """The context without images of times and cameras that are not the config's: what `step` would look at."""
        names, times = self.context_names(view), window_times(view.time, self.config)
        kept = [c for c in context if isinstance(c, ContextFrame) or c.frame.time in times]
        kept = [c if isinstance(c, ContextFrame) or c.frame.cameras.names == names else c.select(names) for c in kept]
        return [c for c in kept if isinstance(c, ContextFrame) or len(c.frame.cameras)]

    def _encode_targets(
        self, views: Sequence[IncompleteView], coarse: Sequence[Float[Tensor, "3 _h _w"]]
    ) -> list[Target]:
        """Tokens of every kept patch of each view; those with any pixel of E > 0 are the input set P."""
        stacks: list[Images] = [target_images(*own, self.config) for own in zip(views, coarse, strict=True)]
        with self.autocast():
            tokens = self.tokeniser(stacks)
        parts = zip(views, stacks, tokens.split([len(stack.places) for stack in stacks]), strict=True)
        return [
            Target(view, stack.places, own, stack.channels[0], any_in_patch(view.error[None] > 0)[stack.kept])
            for view, stack, own in parts
        ]

    def _decode(
        self,
        targets: Sequence[Target],
        contexts: Sequence[Sequence[ContextFrame]],
        top_k: int | None,
        matches: Sequence[Correspondences | None],
    ) -> tuple[list[Float[Tensor, "patch output 28 28"]], list[Tensor | None]]:
        """The decoder's patches for each target's incomplete patches, and what attention missed of its matches."""
        with self.autocast():
            own = [self.transformer.project_context(t.tokens[~t.incomplete]) for t in targets]
        batch = assemble(targets, contexts, own, self.config)
        top_k = self.config.top_k if top_k is None else top_k
        guide = _guide(targets, contexts, matches, (batch.at.present.shape[1], batch.context_at.present.shape[1]))
        with self.autocast():
            tokens = self.transformer(batch.queries, batch.at, batch.keys_values, batch.context_at, top_k, guide)
            decoded = self.decoder(tokens[batch.at.present], torch.cat([_pixels(t) for t in targets]))
        patches = decoded.float().split([int(t.incomplete.sum()) for t in targets])
        return list(patches), [None] * len(targets) if guide is None else guide.missed


def _context_frames(
    views: ContextViews, images: Images, tokens: Tensor, keys_values: Tensor, around: bool
) -> tuple[ContextFrame, ...]:
    """The encoded patches of one time, lifted and split by camera."""
    cameras, places = views.frame.cameras, images.places
    depths = patch_depths(views.depth, images.foreground, around)
    points, valid = lift(places, depths, cameras)
    uv_px = centers_px(places)
    frames, first = [], 0
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
                # Copies, so that no frame keeps alive the memory of those it was encoded with.
                tokens=tokens[own].clone(),
                keys_values=keys_values[:, :, own].clone(memory_format=torch.contiguous_format),
            )
        )
        first += count
    return tuple(frames)


def _guide(
    targets: Sequence[Target],
    contexts: Sequence[Sequence[ContextFrame]],
    matches: Sequence[Correspondences | None],
    size: tuple[int, int],
) -> AttentionGuide | None:
    """What so many queries should find among so many keys; None where no target has any match."""
    if all(own is None for own in matches):
        return None
    sought = torch.zeros(len(targets), *size, dtype=torch.bool, device=targets[0].tokens.device)
    for n, (target, frames, own) in enumerate(zip(targets, contexts, matches, strict=True)):
        if own is not None:
            found = sought_keys(own, target.places[target.incomplete], frames)
            sought[n, : found.shape[0], : found.shape[1]] = found
    return AttentionGuide(sought)


def _prediction(
    target: Target,
    patches: Float[Tensor, "patch output 28 28"] | None,
    config: InpainterConfig,
    missed: Float[Tensor, ""] | None,
) -> Prediction:
    """Patches back in their places, blended, and the view completed; without patches it stays as it is."""
    view = target.view
    alpha = covered(view) if config.background == "white" else None
    if patches is None:
        return Prediction(torch.zeros_like(view.rgb), torch.zeros_like(view.mask), target.shown[:3], view.rgb, alpha)
    height, width = view.mask.shape
    merged, coverage = merge(patches, target.places[target.incomplete], (1, height, width), STEP_PX)
    inpainted = merged[0, :3]
    if len(merged[0]) > 3:
        inpainted = torch.lerp(target.shown[:3] * coverage, inpainted, merged[0, 3])
    completed = blend(view.rgb, view.error, inpainted, coverage[0], clamp=False)
    return Prediction(inpainted, coverage[0], target.shown[:3], completed, alpha, missed)


def _pixels(target: Target) -> Float[Tensor, "patch channel 28 28"]:
    """What the encoder was shown of the incomplete patches."""
    height, width = padded_size(*grid_shape(*target.view.mask.shape))
    full = crop(target.shown, 0, 0, (height, width))[None]
    return split(full, target.places[target.incomplete], PATCH_PX, STEP_PX)
