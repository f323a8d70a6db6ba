"""Training samples of large studio rigs: all held-out cameras of a rig share its hull, masks and images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from random import Random

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from viewmend.frame_cache import CachedFrame, cache_frame
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import HullConfig
from viewmend.models.classical import Unfilled
from viewmend.rendering.view import RenderConfig
from viewmend.scenes.held_out import Split
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio
from viewmend.training.config import SamplingConfig, SceneConfig
from viewmend.training.samples import Sample, black_image
from viewmend.training.scenes import random_studio, training_people
from viewmend.types import IncompleteView, MultiViewFrame

HELD_FRACTION = 1 / 4
"""Fraction of a rig's cameras that are held out together; the hull is computed from the others."""
FEW_CAMERAS = (8, 16)
"""Smallest and largest number of cameras in rigs of few cameras, whose hulls are too large."""


@dataclass(frozen=True)
class WrongMasks:
    """How some given masks M_t differ from the truth, as predicted ones do."""

    fraction: float = 0.25
    """Fraction of the given masks that are wrong."""
    most_px: int = 4
    """Masks are dilated or eroded by up to this many pixels."""

    def apply(self, mask: Float[Tensor, "height width"], random: Random) -> Float[Tensor, "height width"]:
        """The mask, or a wrong one."""
        if random.random() >= self.fraction:
            return mask
        size = 2 * random.randint(1, self.most_px) + 1
        sign = random.choice((-1, 1))
        return sign * max_pool2d(sign * mask[None], size, 1, size // 2)[0]


class SharedRigScenes:
    """Samples of studio rigs. A rig is drawn once for all of its held-out cameras.

    Each frame has the masks of all cameras, but only the images that a sample needs. A protocol is
    chosen for a whole rig: with "hull-with-target-mask", the hull is computed from the masks of all held-out
    cameras, too.
    """

    def __init__(
        self, config: SceneConfig, sampling: SamplingConfig, seed: str, split: Split = "training"
    ) -> None:
        """`seed` determines everything random except the people, whose seeds belong to the split.

        Raises:
            ValueError: the split is test, the config's characters or motions are reserved for
                tests, or the samples are clips, or have cameras besides the source views.
        """
        if sampling.clip_length != 1 or sampling.num_ray_views or sampling.min_context_views:
            raise ValueError("expected samples of one view with its source views, got clips or more cameras")
        self.config = training_people(config, split)
        self.sampling = sampling
        self.seed = seed
        self.split: Split = split

    def scene(self, number: int) -> list[Sample]:
        """The samples of rig `number`: one for each held-out camera whose view has enough holes."""
        random = Random(f"{self.seed}/{number}")
        config = self.config
        if config.few_cameras_fraction and random.random() < config.few_cameras_fraction:
            config = replace(config, cameras=FEW_CAMERAS, rigs=("ring", "dome"), protocols=("strict",))
        studio = Studio(random_studio(config, max(self.sampling.frames) + 1, random, self.split))
        whole_window = random.random() < self.sampling.window_fraction
        times = self.sampling.frames if whole_window else self.sampling.frames[-1:]
        return _SharedRig(studio, config, self.sampling, random).samples(times)


@dataclass(frozen=True)
class _Target:
    """A held-out camera whose view has enough holes."""

    camera: Cameras
    truth: MultiViewFrame
    target_mask: Float[Tensor, "height width"] | None
    render: RenderConfig
    sources: tuple[str, ...]


class _SharedRig:
    """One rig of the studio, some of whose cameras are held out."""

    def __init__(self, studio: Studio, config: SceneConfig, sampling: SamplingConfig, random: Random) -> None:
        names = studio.cameras.names
        self.studio = studio
        self.config = config
        self.sampling = sampling
        self.random = random
        self.hull = HullConfig(resolution=config.hull_resolution)
        self.held = tuple(random.sample(names, max(1, int(HELD_FRACTION * len(names)))))
        self.others = tuple(name for name in names if name not in self.held)
        self.protocol = random.choice(config.protocols)

    def samples(self, times: Sequence[int]) -> list[Sample]:
        """The samples at the last of these frames, with context of all of them."""
        *before, now = times
        geometry = self._frame(now, ())
        targets = self._choose_targets(geometry, now)
        if not targets:
            return []
        shown = {name for target in targets for name in target.sources}
        stream = Stream(Unfilled(), StreamConfig(memory_mb=None))
        frames = [stream.add_frame(self.studio.read(now, self._in_order(shown)), geometry.proxy)]
        frames += [self._frame(time, self._in_order(shown)) for time in reversed(before)]
        return [self._sample(target, stream, frames) for target in targets]

    def _in_order(self, names: set[str]) -> tuple[str, ...]:
        return tuple(name for name in self.others if name in names)

    def _frame(self, time: int, coloured: tuple[str, ...]) -> CachedFrame:
        """A frame with its hull. Only `coloured` cameras have images; without any, all images are black."""
        rest = tuple(name for name in self.others if name not in coloured)
        carving = self.studio.silhouettes(time, rest)
        held = self.studio.silhouettes(time, self.held) if self.protocol == "hull-with-target-mask" else None
        if coloured:
            frame = replace(self.studio.read(time, coloured), depth=None)
            return cache_frame(frame, None, self.hull, carving.joined(held))
        black = carving.mask.new_zeros(len(rest), 3, *carving.mask.shape[1:])
        return cache_frame(MultiViewFrame(carving.cameras, black, carving.mask, time), None, self.hull, held)

    def _choose_targets(self, geometry: CachedFrame, time: int) -> list[_Target]:
        """The first `num_holdout_views` held-out cameras whose views have enough holes."""
        stream = Stream(Unfilled(), StreamConfig(memory_mb=None))
        stream.add_frame(geometry.frame, geometry.proxy)
        targets: list[_Target] = []
        for name in self.held:
            if len(targets) == self.config.num_holdout_views:
                break
            target = self._target(stream, name, time)
            if target is not None:
                targets.append(target)
        return targets

    def _target(self, stream: Stream, name: str, time: int) -> _Target | None:
        """A held-out camera; None if its view has too few holes."""
        camera = self.studio.cameras.select([name])
        cameras = self.random.choices(self.sampling.num_source_views, self.sampling.source_view_weights)[0]
        render = RenderConfig(cameras=cameras)
        view = stream.with_render_config(render).render(camera, time)
        if int(view.holes.sum()) < self.sampling.min_hole_px:
            return None
        truth = replace(
            self.studio.truth(self.studio.true_cameras.select([name]), time, on_stage=True), cameras=camera
        )
        assert truth.mask is not None, "the studio draws masks"
        target_mask = None
        if self.protocol == "target-mask":
            target_mask = WrongMasks().apply(truth.mask[0].float() / 255, self.random)
            if int((view.holes & (target_mask > 0)).sum()) < self.sampling.min_hole_px:
                return None
        return _Target(camera, truth, target_mask, render, view.source_views)

    def _sample(self, target: _Target, stream: Stream, frames: Sequence[CachedFrame]) -> Sample:
        time = frames[0].frame.time
        render = stream.with_render_config(target.render)
        view: IncompleteView = render.render(target.camera, time, target_mask=target.target_mask)
        # The masks and names of cameras that no sample shows are of no use to the model, and large to store.
        view = replace(view, candidate_views=view.source_views, silhouettes=None)
        context = [frame.context(view.source_views) for frame in frames]
        seen = tuple(views for views in context if views is not None)
        assert target.truth.mask is not None, "the studio draws masks"
        return Sample(view, seen, None, black_image(target.truth), alpha=target.truth.mask[0])
