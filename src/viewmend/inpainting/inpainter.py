"""The inpainter: an incomplete view and its context to a complete view (sections 2 to 7 and 9)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.inpainting.assembly import Target, assemble
from viewmend.inpainting.coarse_fill import fill
from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.context import ContextCache, ContextFrame, window_times
from viewmend.inpainting.coordinates import lift, patch_depths
from viewmend.inpainting.decoder import Decoder, blend
from viewmend.inpainting.identity_init import identity_init
from viewmend.inpainting.images import Images, Tokeniser, context_images, target_images
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
from viewmend.inpainting.protocol import Source, State
from viewmend.inpainting.ray_blend_net import RayBlendNet
from viewmend.inpainting.temporal_accumulation import LastView, steadied
from viewmend.inpainting.transformer import Transformer
from viewmend.views import CompletedView, ContextViews, IncompleteView


@dataclass(frozen=True)
class Prediction:
    """What the network made of one view."""

    inpainted: Float[Tensor, "3 height width"]
    """Ftilde: the decoded patches, blended; about [0, 1] but not clamped; 0 where not covered."""
    coverage: Float[Tensor, "height width"]
    """1 where a decoded patch covers the pixel, else 0."""
    filled: Float[Tensor, "3 height width"]
    """What the encoder was shown: with `prefill` the view with its holes filled before any patch was decoded."""
    completed: Float[Tensor, "3 height width"]
    """Fhat = E Ftilde + (1 - E) F, Ftilde clamped; F bit for bit where E is 0."""


class Inpainter(nn.Module):
    """T(F[t] | G[t], I[i, tau]) of section 1. Keeps no state between calls: streams pass theirs along."""

    def __init__(self, config: InpainterConfig) -> None:
        super().__init__()
        self.config = config
        self.tokeniser = Tokeniser(config)
        self.transformer = Transformer(config)
        self.decoder = Decoder(config)
        self.ray_reader = RayBlendNet() if config.rays else None
        if config.colour_path:
            identity_init(self.tokeniser.linear, self.decoder.linear, config)
        self.compute_dtype = torch.float32
        """Set to torch.bfloat16 to run the networks under autocast; coordinates stay float32."""

    def autocast(self) -> torch.autocast:
        """The context in which the networks compute in `compute_dtype`."""
        device = self.decoder.linear.weight.device
        return torch.autocast(device.type, self.compute_dtype, enabled=self.compute_dtype != torch.float32)

    def encode_context(self, views: ContextViews) -> tuple[ContextFrame, ...]:
        """One frame to remember per camera of `views`, in their order."""
        return self.encode_contexts([views])[0]

    def encode_contexts(self, many: Sequence[ContextViews]) -> list[tuple[ContextFrame, ...]]:
        """`encode_context` of each (several times, or several scenes), all images in one batch."""
        if not many:
            return []
        stacks = [context_images(views, self.config) for views in many]
        with self.autocast():
            tokens = self.tokeniser(stacks)
            keys_values = self.transformer.project_context(tokens)
        counts = [len(stack.places) for stack in stacks]
        parts = zip(many, stacks, tokens.split(counts), keys_values.split(counts, 2), strict=True)
        return [_context_frames(*part) for part in parts]

    def forward(
        self,
        views: Sequence[IncompleteView],
        contexts: Sequence[Sequence[ContextFrame | ContextViews]],
        top_k: int | None = None,
        nearby: Sequence[ContextViews | None] | None = None,
    ) -> list[Prediction]:
        """`predict`, whose contexts may also be camera images; these are encoded first, all in one batch.

        Of the images, those that `step` would not look at are passed over.
        """
        contexts = [self._looked_at(*own) for own in zip(views, contexts, strict=True)]
        fresh = [item for context in contexts for item in context if isinstance(item, ContextViews)]
        encoded = iter(self.encode_contexts(fresh))
        frames = [
            [f for item in context for f in (next(encoded) if isinstance(item, ContextViews) else (item,))]
            for context in contexts
        ]
        return self.predict(views, frames, top_k, nearby)

    def predict(
        self,
        views: Sequence[IncompleteView],
        contexts: Sequence[Sequence[ContextFrame]],
        top_k: int | None = None,
        nearby: Sequence[ContextViews | None] | None = None,
    ) -> list[Prediction]:
        """One prediction per view from its own context frames (any number, 0 included).

        `top_k` context tokens survive pruning; None takes the config's. `nearby` is what the cameras near each view see
        at its time, for `rays`; None where there are none. Gradients reach every parameter.
        """
        if len(views) != len(contexts):
            raise ValueError(f"expected one context per view, got {len(views)} views and {len(contexts)} contexts")
        targets = self._encode_targets(views, nearby or [None] * len(views))
        asking = [i for i, target in enumerate(targets) if bool(target.incomplete.any())]
        patches: dict[int, Tensor] = {}
        if asking:
            decoded = self._decode([targets[i] for i in asking], [contexts[i] for i in asking], top_k)
            patches = dict(zip(asking, decoded, strict=True))
        return [_prediction(target, patches.get(i)) for i, target in enumerate(targets)]

    def prefill(
        self, views: Sequence[IncompleteView], nearby: Sequence[ContextViews | None]
    ) -> list[Float[Tensor, "3 _h _w"]]:
        """What the encoder is shown as each view's colours: its holes filled as the config says."""
        if self.ray_reader is not None:
            with self.autocast():
                return self.ray_reader(views, nearby)
        if self.config.prefill:
            return [fill(view.rgb, view.error > 0, view.mask > 0) for view in views]
        return [view.rgb for view in views]

    @torch.no_grad()
    def first_fill(self, view: IncompleteView, nearby: ContextViews | None) -> CompletedView:
        """The view completed by the first fill alone, without the transformer: for whoever has no time for more.

        Raises:
            ValueError: the model has no such fill.
        """
        if not self.config.prefill:
            raise ValueError("expected a model with prefill, got one without; complete the view by `step`")
        filled = self.prefill([view], [nearby])[0].float()
        return CompletedView(view, blend(view.rgb, view.error, filled, torch.ones_like(view.mask)))

    def _encode_targets(self, views: Sequence[IncompleteView], nearby: Sequence[ContextViews | None]) -> list[Target]:
        """Tokens of every kept patch of each view; those with any pixel of E > 0 are the input set P."""
        filled = self.prefill(views, nearby)
        stacks: list[Images] = [target_images(*own, self.config) for own in zip(views, filled, strict=True)]
        with self.autocast():
            tokens = self.tokeniser(stacks)
        targets = []
        parts = zip(views, stacks, tokens.split([len(stack.places) for stack in stacks]), strict=True)
        for view, stack, own in parts:
            incomplete = any_in_patch(view.error[None] > 0)[tuple(stack.places.unbind(1))]
            targets.append(Target(view, stack.places, own, stack.channels[0], incomplete))
        return targets

    def _decode(
        self, targets: Sequence[Target], contexts: Sequence[Sequence[ContextFrame]], top_k: int | None
    ) -> list[Float[Tensor, "patch output 28 28"]]:
        """The decoder's patches for each target's incomplete patches."""
        with self.autocast():
            own = [self.transformer.project_context(t.tokens[~t.incomplete]) for t in targets]
        batch = assemble(targets, contexts, own, self.config)
        with self.autocast():
            tokens = self.transformer(
                batch.queries,
                batch.at,
                batch.keys_values,
                batch.context_at,
                self.config.top_k if top_k is None else top_k,
            )
            decoded = self.decoder(tokens[batch.at.present], torch.cat([_pixels(t) for t in targets]))
        return list(decoded.float().split([int(t.incomplete.sum()) for t in targets]))

    def initial_state(self) -> State:
        """The state before the first view of a stream."""
        return State()

    @torch.no_grad()
    def step(
        self, view: IncompleteView, source: Source, state: State, top_k: int | None = None
    ) -> tuple[CompletedView, State]:
        """The completed view and the state for the next one (section 9).

        `source` is asked for frames of `view.source_views` (or `context_cameras`) that the window needs and the state
        has not, and for those of `view.candidate_views` that `rays` reads now; a view without holes comes back at once.
        """
        if not bool((view.error > 0).any()):
            return self.keep_steady(CompletedView(view, view.rgb), state)
        fresh, nearby = self._look(view, source, state.cache)
        frames = [frame for group in self.encode_contexts(fresh) for frame in group]
        cache = state.cache.add(frames, view.time, self.config)
        context = cache.find(self.context_names(view), window_times(view.time, self.config))
        prediction = self.predict([view], [context], top_k, [nearby])[0]
        return self.keep_steady(CompletedView(view, prediction.completed), State(cache, state.last))

    def keep_steady(self, completed: CompletedView, state: State) -> tuple[CompletedView, State]:
        """The view as its stream shows it, by `InpainterConfig.steady`, and the state after it."""
        if not self.config.steady:
            return completed, state
        shown = steadied(completed, state.last, self.config.steady)
        return shown, replace(state, last=LastView.of(shown))

    def context_names(self, view: IncompleteView) -> tuple[str, ...]:
        """The cameras that are context."""
        count = self.config.context_cameras
        return view.source_views if count is None else view.closest_views(count)

    def _looked_at(
        self, view: IncompleteView, context: Sequence[ContextFrame | ContextViews]
    ) -> list[ContextFrame | ContextViews]:
        """The context without images of times and cameras that are not the config's."""
        names, times = self.context_names(view), window_times(view.time, self.config)
        kept = [c for c in context if isinstance(c, ContextFrame) or c.frame.time in times]
        return [c if isinstance(c, ContextFrame) or c.frame.cameras.names == names else c.select(names) for c in kept]

    def _look(
        self, view: IncompleteView, source: Source, cache: ContextCache
    ) -> tuple[list[ContextViews], ContextViews | None]:
        """What the window needs and the cache has not, by time; and what the cameras near the view see now."""
        around = view.closest_views(self.config.rays)
        fresh, nearby = [], None
        for time in window_times(view.time, self.config):
            new = cache.missing(self.context_names(view), time)
            names = tuple(dict.fromkeys((*new, *around))) if time == view.time else new
            seen = source(time, names) if names else None
            if seen is not None:
                fresh.append(seen.select(new))
                nearby = seen.select(around) if time == view.time and around else nearby
        return [views for views in fresh if len(views.frame.cameras)], nearby


def _context_frames(
    views: ContextViews, images: Images, tokens: Tensor, keys_values: Tensor
) -> tuple[ContextFrame, ...]:
    """The encoded patches of one time, lifted and split by camera."""
    cameras, places = views.frame.cameras, images.places
    depths = patch_depths(views.depth, images.foreground)
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


def _prediction(target: Target, patches: Float[Tensor, "patch output 28 28"] | None) -> Prediction:
    """Patches back in their places, blended, and the view completed; without patches it stays as it is."""
    view = target.view
    if patches is None:
        return Prediction(torch.zeros_like(view.rgb), torch.zeros_like(view.mask), target.shown[:3], view.rgb)
    height, width = view.mask.shape
    merged, coverage = merge(patches, target.places[target.incomplete], (1, height, width), STEP_PX)
    inpainted = merged[0, :3]
    if len(merged[0]) > 3:
        inpainted = torch.lerp(target.shown[:3] * coverage, inpainted, merged[0, 3])
    return Prediction(inpainted, coverage[0], target.shown[:3], blend(view.rgb, view.error, inpainted, coverage[0]))


def _pixels(target: Target) -> Float[Tensor, "patch channel 28 28"]:
    """What the encoder was shown of the incomplete patches."""
    height, width = padded_size(*grid_shape(*target.view.mask.shape))
    full = crop(target.shown, 0, 0, (height, width))[None]
    return split(full, target.places[target.incomplete], PATCH_PX, STEP_PX)
