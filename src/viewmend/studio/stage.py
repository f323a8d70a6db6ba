"""The studio: performers, lights and cameras as a capture with exact truth."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.data.errors import CaptureError
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.studio.imperfections import Imperfections, imperfect_cameras, imperfect_frame, imperfect_masks
from viewmend.studio.performer import Performer, TexturedMesh, TexturePyramid, texture_pyramid
from viewmend.studio.render import Surface, light, render, render_masks, stage_backdrop, stage_lights
from viewmend.studio.rigs import dome_rig, layered_rig, ring_rig
from viewmend.types import MultiViewFrame, Silhouettes
from viewmend.utils.srgb import linear_from_srgb, srgb_from_linear

BOUNDS_SAMPLES = 48
BOUNDS_MARGIN_M = 0.08


@dataclass(frozen=True, kw_only=True)
class StudioConfig:
    """One capture of the studio; all randomness follows from `seed`.

    Examples:
        >>> from viewmend import StudioConfig
        >>> StudioConfig(cameras=8, frames=10, size_px=(640, 480)).fps
        30.0
    """

    seed: int = 0
    """Seed of the performer, the lights, the rig's jitter and the imperfections. Procedural seeds
    from 10000 on are kept for tests and evaluation."""
    cameras: int | Cameras = 12
    """Number of cameras, or the rig itself in the stage's world."""
    rig: Literal["ring", "dome", "layers"] = "ring"
    """Placement of a number of cameras: in a ring, on a dome, or in three layers."""
    frames: int = 30
    """Number of frames."""
    size_px: int | tuple[int, int] = 512
    """Width and height of the images, or side of square ones; a given rig keeps its own."""
    fps: float | int = 30.0
    """Frames per second."""
    performers: Path | None = None
    """A glTF character (.glb, .gltf), or a folder from which one is chosen; None for a
    procedural scene."""
    motions: Path | None = None
    """A BVH motion, or a folder from which one is chosen; goes with `performers`."""
    cloth_variety: float = 0.0
    """Fraction of a glTF character's garments that change colour or cloth by seed; 0 keeps them.
    Procedural performers are always dressed by seed."""
    background: Literal["black", "stage"] = "black"
    """Background of the cameras' images; ground-truth views are always on black."""
    samples_per_side: int = 2
    """Each pixel is the mean of this many samples squared."""
    imperfections: Imperfections = field(default_factory=Imperfections)
    """Imperfections of the capture; none by default."""


class Studio:
    """A capture stage in software: a `CaptureSource` that also renders ground truth for any view.

    Examples:
        >>> from viewmend import Studio, StudioConfig
        >>> studio = Studio(StudioConfig(cameras=4, frames=2, size_px=64))
        >>> studio.read(1).rgb.shape
        torch.Size([4, 3, 64, 64])
    """

    def __init__(self, config: StudioConfig | None = None, performer: Performer | None = None) -> None:
        """Set up the stage.

        Raises:
            CaptureError: performers or motions that are missing, none in their folder, or unreadable.
            ValueError: sizes or counts that are not positive, a variety of cloth beyond [0, 1].
        """
        self.config = config = config or StudioConfig()
        size = (config.size_px, config.size_px) if isinstance(config.size_px, int) else config.size_px
        if config.frames < 1 or not config.fps > 0 or min(size) < 1:
            raise ValueError(
                f"expected at least one frame, a positive rate and size, got {config.frames} frames at "
                f"{config.fps}/s of {size} pixels; correct the studio's config"
            )
        seeds = map(int, np.random.SeedSequence(config.seed).generate_state(5))
        performer_seed, rig_seed, light_seed, self._backdrop_seed, self._error_seed = seeds
        self.performer = performer or _cast(config, performer_seed)
        rig = {"ring": ring_rig, "dome": dome_rig, "layers": layered_rig}[config.rig]
        given = config.cameras
        self.name = f"studio {config.seed}: {self.performer.description}"
        self.frame_ids = tuple(f"{time:06d}" for time in range(config.frames))
        """Six digits each, from 000000."""
        self.fps = float(config.fps) if config.frames > 1 else None
        """Frames per second, None for a single frame."""
        self.up = torch.tensor([0.0, 1.0, 0.0])
        self.true_cameras = given if isinstance(given, Cameras) else rig(given, size, seed=rig_seed)
        """True poses of the cameras; `cameras` has the calibration errors of the capture."""
        self.cameras = imperfect_cameras(self.true_cameras, config.imperfections, self._error_seed)
        """The calibration of the capture, including its errors."""
        self._lights = stage_lights(light_seed)
        self._backdrops: dict[str, Tensor] = {}
        # Cache of the last frame, since a frame and its ground truth are read in pairs.
        self._last_surface: tuple[int, Surface] | None = None
        self._last_pyramid: tuple[tuple[Tensor, ...], TexturePyramid] | None = None

    @property
    def bounds(self) -> Bounds | None:
        """Bounds of the performers over the capture, with a margin (sampled at most 48 times)."""
        return self._bounds

    @cached_property
    def _bounds(self) -> Bounds:
        count = min(self.config.frames, BOUNDS_SAMPLES)
        times = np.linspace(0, self.config.frames - 1, count).round().astype(int)
        corners = [self.scene(int(t)).mesh.vertices.aminmax(dim=0) for t in times]
        low = torch.stack([c.min for c in corners]).amin(0) - BOUNDS_MARGIN_M
        return Bounds(low, torch.stack([c.max for c in corners]).amax(0) + BOUNDS_MARGIN_M)

    def scene(self, time: int) -> TexturedMesh:
        """The performers' surface at index `time`, which may lie beyond the capture's frames."""
        return self.performer.pose(time / self.config.fps)

    def read(self, time: int, names: Sequence[str] | None = None) -> MultiViewFrame:
        """The cameras at index `time`: images and masks with the imperfections, and the true depth.

        Only the cameras of these `names` are drawn; None draws all. A camera's image does not
        depend on the others.

        Raises:
            IndexError: `time` is not in the capture.
        """
        self._check_time(time)
        names = self.cameras.names if names is None else tuple(names)
        numbers = self._numbers(names)
        behind = self.backdrop(names)
        frame = self._draw(self.true_cameras.select(names), time, behind)
        frame = imperfect_frame(frame, self.config.imperfections, self._error_seed, behind, numbers)
        return replace(frame, cameras=self.cameras.select(names))

    def backdrop(self, names: Sequence[str] | None = None) -> Float[Tensor, "view 3 height width"] | None:
        """The stage behind the subject in the images of these cameras, by default all, in linear light.

        None if the background is black.
        """
        if self.config.background != "stage":
            return None
        names = self.cameras.names if names is None else names
        for name in names:
            if name not in self._backdrops:
                camera = self.true_cameras.select([name])
                self._backdrops[name] = stage_backdrop(camera, self._backdrop_seed)[0]
        return torch.stack([self._backdrops[name] for name in names])

    def silhouettes(self, time: int, names: Sequence[str]) -> Silhouettes:
        """Draw the masks of some cameras at index `time`, equal to those of `read`, at a fifth of the cost.

        Raises:
            IndexError: `time` is not in the capture.
        """
        self._check_time(time)
        masks = render_masks(
            self.scene(time).mesh, self.true_cameras.select(names), self.config.samples_per_side
        )
        numbers = self._numbers(names)
        masks = imperfect_masks(masks, self.config.imperfections, self._error_seed, time, numbers)
        return Silhouettes(masks, self.cameras.select(names))

    def _check_time(self, time: int) -> None:
        if not 0 <= time < self.config.frames:
            raise IndexError(f"expected a time from 0 to {self.config.frames - 1}, got {time}")

    def _numbers(self, names: Sequence[str]) -> list[int]:
        """Positions of these cameras in the rig."""
        return [self.cameras.names.index(name) for name in names]

    def truth(self, cameras: Cameras, time: int, on_stage: bool = False) -> MultiViewFrame:
        """Render what perfect cameras anywhere would see at index `time`, with exact mask and depth.

        Colours are the subject's own, not darkened where the mask is soft: times the mask, they are
        the view on black. With `on_stage`, and a stage, they include what is behind soft pixels, as
        in the images of real cameras.
        """
        if on_stage and self.config.background == "stage":
            return self._draw(cameras, time, stage_backdrop(cameras, self._backdrop_seed))
        frame = self._draw(cameras, time, None)
        assert frame.mask is not None, "the studio draws masks"
        share = (frame.mask[:, None].float() / 255).clamp_min(1 / 255)
        straight = srgb_from_linear((linear_from_srgb(frame.rgb.float() / 255) / share).clamp(0, 1))
        return replace(frame, rgb=(255 * straight).round().to(torch.uint8))

    def _draw(
        self, cameras: Cameras, time: int, behind: Float[Tensor, "view 3 height width"] | None
    ) -> MultiViewFrame:
        return replace(render(self._surface(time), cameras, behind, self.config.samples_per_side), time=time)

    def _surface(self, time: int) -> Surface:
        # Another thread may draw another time, so each attribute is read once. Even replacing the last surface
        # lets it run, because tensors are freed without the GIL.
        last = self._last_surface
        if last is not None and last[0] == time:
            return last[1]
        scene = self.scene(time)
        pyramid = self._last_pyramid
        if pyramid is None or [*map(id, pyramid[0])] != [*map(id, scene.textures)]:
            pyramid = scene.textures, texture_pyramid(scene.textures)
            self._last_pyramid = pyramid
        surface = light(scene, self._lights, pyramid[1])
        self._last_surface = time, surface
        return surface


def _cast(config: StudioConfig, seed: int) -> Performer:
    """Make the performer of a config."""
    if config.performers is None and config.motions is None:
        from viewmend.studio.procedural import procedural_scene

        return procedural_scene(config.seed)
    if config.performers is None or config.motions is None:
        missing = "performers" if config.performers is None else "motions"
        raise CaptureError(f"expected performers and motions together, got no {missing}; give both folders")
    from viewmend.studio.gltf_performer import GltfPerformer

    chance = np.random.default_rng(seed)
    character = _pick(config.performers, (".glb", ".gltf"), chance)
    motion = _pick(config.motions, (".bvh",), chance)
    return GltfPerformer(character, motion, seed, config.frames / config.fps, config.cloth_variety)


def _pick(place: Path, suffixes: tuple[str, ...], chance: np.random.Generator) -> Path:
    """Choose the file itself, or one of the folder's."""
    if place.is_file():
        return place
    files = sorted(f for f in place.iterdir() if f.suffix.lower() in suffixes) if place.is_dir() else []
    if not files:
        found = "no such files in it" if place.is_dir() else "no such folder or file"
        raise CaptureError(
            f"{place}: expected a {' or '.join(suffixes)} file or a folder of them, found {found}"
        )
    return files[int(chance.integers(len(files)))]
