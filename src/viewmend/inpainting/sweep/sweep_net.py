"""A reader of whole views: places along every ray are weighed, then cameras are blended at the best one. Ours.

A plane sweep in the interval behind the proxy. At half the resolution each place along a ray is judged by what the
cameras show there, and convolutions over the view decide among places (as over cost volumes, in MVSNet and ENeRF). At
full resolution cameras are looked up at the depth that was found: textures stay sharp, and neighbours agree.
"""

import copy
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.threads import heavy_operations, light_operations
from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.inpainting.network import Network
from viewmend.inpainting.protocol import ContextProvider, HeldOut, RenderQuality, State
from viewmend.inpainting.ray_blend_net import RayBlendNet
from viewmend.inpainting.sweep.alpha_fit import fitted_slope
from viewmend.inpainting.sweep.cells import (
    CELL_PX,
    cell_means,
    cut_to,
    index_image,
    nearest_depth,
    rim_depth,
    scattered,
    stacked,
)
from viewmend.inpainting.sweep.config import OFFSETS, SweepConfig
from viewmend.inpainting.sweep.error_net import ErrorMap, ErrorNet, unread
from viewmend.inpainting.sweep.lookup import COLOUR, FEATURES, MASK, Rays, Scale, Sight
from viewmend.inpainting.sweep.place_net import PlaceNet, Weighed
from viewmend.inpainting.sweep.pyramids import Rig, keep_pyramids
from viewmend.inpainting.sweep.reading import Reading, Swept, finer, uncovered
from viewmend.inpainting.sweep.tiles import in_tiles
from viewmend.inpainting.sweep.unet import UNet
from viewmend.views import CompletedView, ContextViews, IncompleteView

SHOWN_CHANNELS = 7
"""RGB of the guess, M, what is coloured, the largest of the source views' shares, and what is read."""
CHOICES = 4
"""What a pixel may show: trusted cameras at its depth, the most trusted of them alone, the places' mean, the guess."""
TOLD_CHANNELS = 27
"""Each pixel has at full resolution: the choices' colours, two differences and two masks of them, what the lookup says
of the place, and how sure its depth is."""
JOINT = 0.03
"""Pixels whose depth differs from their cell's by less than so many subject sizes are of its surface."""
MARGIN_PX = 16


class SweepNet(Network):
    """Reads the pixels of the proxy that must be mended, and tells their alpha, confidence and depth."""

    config: SweepConfig  # pyright: ignore
    trained_in_bfloat16 = True
    error_rule = "all"
    """What it is made for: it keeps by itself what is right."""

    def __init__(self, config: SweepConfig | None = None) -> None:
        super().__init__()
        config = config or SweepConfig()
        self.config = config  # pyright: ignore[reportIncompatibleVariableOverride]
        self.alpha_slope = 1.0
        self.coarse = RayBlendNet(config.num_views) if config.coarse_fill == "rays" else SmoothFill()
        self.coarse.requires_grad_(False)
        self.errors = ErrorNet(config.error_features) if config.error_features else None
        self.places = PlaceNet(config.width, config.place_channels)
        self.decide = UNet(len(OFFSETS) * config.place_channels + SHOWN_CHANNELS + 2, config.features)
        self.logits = nn.Conv2d(config.features, len(OFFSETS), 1)
        self.pixels = PlaceNet(config.width, config.place_channels)
        told, fine = config.features + TOLD_CHANNELS + config.place_channels, config.fine_features
        self.finish = nn.Sequential(
            *(nn.Conv2d(told, fine, 3, padding=1), nn.ReLU(), nn.Conv2d(fine, fine, 3, padding=1), nn.ReLU()),
            nn.Conv2d(fine, CHOICES + 2, 3, padding=1),
        )

    def forward(
        self,
        view: IncompleteView,
        rig: Rig,
        scale: Scale | None = None,
        read: Bool[Tensor, "height width"] | None = None,
        guess: Float[Tensor, "3 height width"] | None = None,
    ) -> Reading:
        """What the pixels of a view show.

        Args:
            view: of which E is not looked at.
            rig: the cameras.
            scale: the whole view's, where this is a part of it.
            read: which pixels of the proxy and of the rim about it; None for all.
            guess: its part of the `coarse_guess` of the whole view.
        """
        guess = self.coarse_guess(view, rig.views) if guess is None else guess
        read = torch.ones_like(view.mask, dtype=torch.bool) if read is None else read
        return self.read(view, rig, scale or Scale.of(view), read, guess)

    def read(
        self,
        view: IncompleteView,
        sight: Sight,
        scale: Scale,
        read: Bool[Tensor, "height width"],
        guess: Float[Tensor, "3 height width"],
    ) -> Reading:
        """What these pixels show, as far as they are of the proxy or of its rim, by what is looked up in `sight`."""
        depth, coloured = rim_depth(view.depth), view.weights.sum(0) > 0
        read = read & (depth > 0)
        flags = torch.stack([view.mask, coloured.float(), view.weights.amax(0), read.float()])
        shown = torch.cat([guess, flags])
        view = replace(view, depth=depth)
        swept = self._sweep(view, sight, scale, read, shown)
        return self._blend(view, sight, scale, torch.nonzero(read), shown, swept)

    @torch.no_grad()
    def coarse_guess(
        self, view: IncompleteView, seen: ContextViews | None, quick: bool = False
    ) -> Float[Tensor, "3 height width"]:
        """The whole view, with what no source view coloured filled by what the cameras show or by its surroundings.

        `quick` looks at surroundings alone.
        """
        fill = SmoothFill() if quick else self.coarse
        return fill([replace(view, error=view.holes.to(view.error))], [seen])[0].float()

    @torch.no_grad()
    @light_operations()
    def error_map(self, view: IncompleteView, context: ContextProvider) -> ErrorMap | None:
        """How wrong each pixel seems to be, for the rule `wrong`; None where no camera may be looked at.

        Raises:
            ValueError: this model was trained without an `ErrorNet`.
        """
        if self.errors is None:
            raise ValueError(
                "expected a model that predicts errors for the rule 'wrong', got one without; give --error-rule all, "
                "or train it with --model.error-features 24"
            )
        names = view.closest_views(self.config.num_views)
        seen = context(view.time, names) if names else None
        return seen and self.errors.expected(view, Rig.of(seen, view.silhouettes, context), context.quality)

    @property
    def tells_errors(self) -> bool:
        """Whether it can say where most is to be gained."""
        return self.errors is not None

    encode_cameras = staticmethod(keep_pyramids)

    @torch.no_grad()
    def fitted_to_rig(self, held: Sequence[HeldOut]) -> "SweepNet":
        """The same layers, with alpha as soft as views of the rig's own cameras say."""
        plain, views = copy.copy(self), []
        plain.alpha_slope = 1.0
        for own in held:
            found, _ = plain.step(own.view, own.context, plain.initial_state())
            at = found.opacity > 0
            views.append((found.rgb[:, at], found.opacity[at], own.truth[:, at]))
        fitted = copy.copy(self)
        fitted.alpha_slope = fitted_slope(views)
        return fitted

    def crop_margin_px(self, quality: RenderQuality) -> int:
        """What is around the subject tells where its outline is."""
        return max(MARGIN_PX, self.coarse.crop_margin_px(quality))

    @torch.no_grad()
    @light_operations()
    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """The view with all of E read, on the proxy and its rim, or faded; a view without E comes back at once.

        With a `RenderQuality.read_fraction` of 0 nothing is read: holes are filled from their surroundings.
        """
        read = view.read & (rim_depth(view.depth) > 0)
        fades = torch.zeros_like(read) if view.fade is None else view.fade > 0
        names = view.closest_views(self.config.num_views)
        if context.quality.read_fraction == 0 and bool((read | fades).any()):
            return unread(view, fades, self.coarse_guess(view, None, quick=True)), state
        seen = context(view.time, names) if names and bool(read.any()) else None
        if seen is None:
            return (CompletedView(view, view.rgb) if view.fade is None else unread(view, fades)), state
        quick = context.quality.read_fraction is not None
        guess = self.coarse_guess(view, seen, quick)
        found = self(view, Rig.of(seen, view.silhouettes, context), read=read, guess=guess)
        in_holes = guess if not quick and isinstance(self.coarse, RayBlendNet) else None
        return found.laid_into(view, read, fades, self.alpha_slope, in_holes), state

    def _sweep(
        self,
        view: IncompleteView,
        sight: Sight,
        scale: Scale,
        read: Bool[Tensor, "height width"],
        shown: Float[Tensor, "7 height width"],
    ) -> Swept:
        """Every place along the rays of cells, judged by itself and by its neighbours."""
        depth = nearest_depth(view.depth * read)
        cells = torch.nonzero(depth > 0)
        along = depth[tuple(cells.T)][:, None] + scale.size_m * depth.new_tensor(OFFSETS)
        middles = CELL_PX * (cells.flip(1).double() + 0.5)
        rays = Rays(view.camera, middles, along).split(sight.rays_at_once)
        front = nearest_depth(view.depth)
        beyond = torch.where(front > 0, ((front - scale.depth_m) / scale.size_m).tanh(), 0.0)
        means = cell_means(shown)
        with self.autocast():
            parts = [self.places(sight.look_up(part, view.source_views, float(CELL_PX), scale)) for part in rays]
            weighed = Weighed(*map(torch.cat, zip(*parts, strict=True)))
            features = weighed.features.flatten(1).to(self.compute_dtype)
            told = torch.cat([means, beyond[None], (front > 0)[None].to(means)]).to(features)
            with heavy_operations():
                decided = self.decide.of_points(features, cells, stacked(told))
            logits = self.logits(decided)[0, :, cells[:, 0], cells[:, 1]].T.float() + weighed.score.float()
        return Swept(cells, index_image(cells, depth.shape), depth, logits, weighed, decided)

    def _blend(
        self,
        view: IncompleteView,
        sight: Sight,
        scale: Scale,
        pixels: Int[Tensor, "pixel 2"],
        shown: Float[Tensor, "7 height width"],
        swept: Swept,
    ) -> Reading:
        """The cameras at the depth of each pixel, and what of them it shows."""
        place, offset, certain = self._depth_offset(pixels, swept)
        cell = swept.cell_index[tuple((pixels // CELL_PX).T)]
        own, front = view.depth[tuple(pixels.T)], swept.depth[tuple(swept.cells.T)][cell]
        front = torch.where((own - front).abs() < JOINT * scale.size_m, own, front)
        depth = front + scale.size_m * offset
        uv, at = pixels.flip(1).double() + 0.5, depth.detach()[:, None]
        found = sight.look_up(Rays(view.camera, uv, at), view.source_views, 1.0, scale)
        before = swept.weighed.trust[cell, place]
        with self.autocast():
            weighed = self.pixels(found, before[:, None])
        sharp = uncovered(weighed.colour[:, 0], weighed.mask[:, 0])
        best = weighed.trust[:, 0].argmax(1)[:, None, None].expand(-1, 1, FEATURES)
        best = found.features[:, 0].gather(1, best)[:, 0]
        single = uncovered(best[:, COLOUR], best[:, MASK])
        shares = swept.logits.softmax(1)[..., None]
        means = torch.cat([(shares * part).sum(1) for part in (swept.weighed.colour, swept.weighed.mask)], 1)
        means = finer(means, swept, pixels)
        soft = uncovered(means[:, :3], means[:, 3:])
        here = shown[:, pixels[:, 0], pixels[:, 1]].T
        guess = here[:, :3]
        told = [sharp, single, soft, guess, sharp - guess, weighed.mask[:, 0], means[:, 3:], here[:, 4:6]]
        told += [found.stats[:, 0, 3:6].mean(1, keepdim=True), found.stats[:, 0, 6:], certain[:, None]]
        told += [(sharp - single).abs().mean(1, keepdim=True), offset[:, None], weighed.features[:, 0]]
        out = self._finish(torch.cat(told, 1), pixels, view.mask.shape, swept.decided)
        choice = out[:, :CHOICES].softmax(1)
        straight = (choice[..., None] * torch.stack([sharp, single, soft, guess], 1)).sum(1)
        alpha = (out[:, CHOICES] + 4 * (weighed.mask[:, 0, 0] - 0.5)).sigmoid()
        confidence = out[:, CHOICES + 1].sigmoid()
        return Reading(pixels, alpha[:, None] * straight, alpha, confidence, depth, weighed.trust[:, 0], swept)

    def _depth_offset(
        self, pixels: Int[Tensor, "pixel 2"], swept: Swept
    ) -> tuple[Int[Tensor, "pixel"], Float[Tensor, "pixel"], Float[Tensor, "pixel"]]:
        """The most probable place of each pixel, the mean offset about it in subject sizes, and its probability."""
        shares = finer(swept.logits.softmax(1), swept, pixels)
        place = shares.argmax(1)
        around = torch.stack([place - 1, place, place + 1], 1).clamp(0, len(OFFSETS) - 1)
        weight = shares.gather(1, around) + 1e-6
        offset = (weight * weight.new_tensor(OFFSETS)[around]).sum(1) / weight.sum(1)
        return place, offset, shares.amax(1)

    def _finish(
        self,
        told: Float[Tensor, "pixel told"],
        pixels: Int[Tensor, "pixel 2"],
        shape: torch.Size,
        decided: Float[Tensor, "1 feature rows columns"],
    ) -> Float[Tensor, "pixel output"]:
        """What convolutions over the view make of its pixels."""
        with self.autocast(), heavy_operations():
            if told.device.type == "cpu" and not torch.is_grad_enabled():
                return in_tiles(self.finish, decided, told.to(decided), pixels, shape).float()
            near = F.interpolate(decided, scale_factor=CELL_PX, mode="bilinear", align_corners=False)
            near = cut_to(near[0], shape)
            out = self.finish(stacked(near, scattered(told.to(near), pixels, shape)))
        return out[0, :, pixels[:, 0], pixels[:, 1]].T.float()
