"""What is evaluated: a rig's frames, and the truth of a camera that was left out; the fixed studio sets P and Q."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from viewmend.capture.errors import CaptureError
from viewmend.evaluation.temporal import backward_flow
from viewmend.geometry.bounds import Bounds
from viewmend.studio.procedural import PerformerStyle, procedural_scene
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.views import MultiViewFrame

FIRST_SEED = 10000
"""Of set P; procedural seeds from here on were never trained on."""
PROCEDURAL_SCENES = 30
RINGS = (12, 8)
"""Cameras of the two rigs, the left-out one among them: a usual ring, and a sparse one."""
TEMPOS = ("calm", "dance", "fast")
FIRST_PAIR_SEED = 20000
"""Of set Q: of lights, rig and the part of the motion that is shown."""
FRAMES, SIZE_PX = 10, 512

Background = Literal["black", "stage"]
Tempo = Literal["calm", "dance", "fast"]


@dataclass(frozen=True)
class SceneFrame:
    """One time of a scene."""

    inputs: MultiViewFrame
    """What the rig saw, without the camera that was left out."""
    truth: MultiViewFrame
    """What that camera saw (one view), with its mask."""
    bounds: Bounds | None
    """The volume that may hold the subject, None to find it."""
    backward_flow_px: Float[Tensor, "height width 2"] | None = None
    """Where in the previous true image each pixel's surface point was (`backward_flow`); None where nobody knows."""


@runtime_checkable
class EvaluationScene(Protocol):
    """A stream with truth. Scenes can be pickled: they hold no frames, only how to get them."""

    @property
    def name(self) -> str:
        """Unique among the scenes of an evaluation."""
        ...

    @property
    def set(self) -> str:
        """The set it belongs to: scores are averaged over it."""
        ...

    @property
    def rig(self) -> str:
        """Which cameras look, for tables by kind."""
        ...

    @property
    def style(self) -> str:
        """What happens, for tables by kind."""
        ...

    @property
    def definition(self) -> str:
        """All that its frames depend on, in words that are the same on every machine."""
        ...

    def frames(self, device: str) -> Iterator[SceneFrame]:
        """Its frames in order of time, on a device."""
        ...


@dataclass(frozen=True, kw_only=True)
class StudioScene:
    """A scene of the studio, perfectly calibrated; the truth is exact."""

    name: str
    set: str
    rig: str
    style: str
    config: StudioConfig
    held: str
    """The camera that is left out."""
    tempo: Tempo | None = None
    """Of procedural people; None leaves it to the seed."""
    files_sha256: tuple[str, ...] = ()
    """Of the character and the motion, for people who are no procedural ones."""

    @property
    def definition(self) -> str:
        """The studio's config without paths and device, and what else matters."""
        config = replace(self.config, performers=None, motions=None, device="cpu")
        return repr((config, self.held, self.tempo, self.files_sha256))

    def studio(self, device: str = "cpu") -> Studio:
        """The studio with its people: frames of all cameras, the one that is left out among them."""
        tempo, config = self.tempo, replace(self.config, device=device)
        return Studio(
            config, None if tempo is None else procedural_scene(config.seed, style=PerformerStyle(tempo=tempo))
        )

    def frames(self, device: str) -> Iterator[SceneFrame]:
        """Renders them, one at a time."""
        studio = self.studio(device)
        before: MultiViewFrame | None = None
        for time in range(self.config.frames):
            frame = studio.read(time)
            truth = frame.select([self.held])
            source = None
            if before is not None and before.depth is not None:
                now, then = (studio.scene(t).mesh for t in (time, time - 1))
                source = backward_flow(now, then, before.depth[0], truth.cameras)
            inputs = replace(frame.without([self.held]), depth=None)  # the truth: no method may look
            yield SceneFrame(inputs, truth, None, source)
            before = truth


def procedural_set(
    frames: int = FRAMES, size_px: int = SIZE_PX, background: Background = "black"
) -> tuple[StudioScene, ...]:
    """P: 30 procedural scenes; both rigs and the three tempos take turns, so that each pair comes five times.

    With a stage as the background it is P-stage: the same people, for models that are not given masks.
    """
    name = "P" if background == "black" else f"P-{background}"
    scenes = []
    for n in range(PROCEDURAL_SCENES):
        seed, cameras, tempo = FIRST_SEED + n, RINGS[n % 2], TEMPOS[n % 3]
        scenes.append(
            StudioScene(
                name=f"{name}-{seed}",
                set=name,
                rig=f"ring of {cameras}",
                style=tempo,
                config=StudioConfig(seed=seed, cameras=cameras, frames=frames, size_px=size_px, background=background),
                held=held_camera(seed, cameras),
                tempo=tempo,
            )
        )
    return tuple(scenes)


def performer_set(
    folder: Path, motions: Path | None = None, frames: int = FRAMES, size_px: int = SIZE_PX
) -> tuple[StudioScene, ...]:
    """Q: every character with every motion, each with both rigs.

    Args:
        folder: characters (.glb, .gltf) in it or in its `test`.
        motions: BVH files in it; by default `motions/test`, `motions`, or the folder itself.
        frames: of each scene.
        size_px: width and height.

    Raises:
        CaptureError: there are no characters or no motions.
    """
    people = _files((folder / "test", folder), (".glb", ".gltf"), "characters")
    clips = _files(
        (motions,) if motions else (folder / "motions/test", folder / "motions", folder), (".bvh",), "motions"
    )
    sha256 = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in (*people, *clips)}
    scenes = []
    for n, (person, clip) in enumerate((p, c) for p in people for c in clips):
        for cameras in RINGS:
            seed = FIRST_PAIR_SEED + n
            config = StudioConfig(seed=seed, cameras=cameras, frames=frames, size_px=size_px)
            scenes.append(
                StudioScene(
                    name=f"Q-{person.stem}-{clip.stem}-{cameras}",
                    set="Q",
                    rig=f"ring of {cameras}",
                    style=clip.stem,
                    config=replace(config, performers=person, motions=clip),
                    held=held_camera(seed, cameras),
                    files_sha256=(sha256[person], sha256[clip]),
                )
            )
    return tuple(scenes)


def held_camera(seed: int, cameras: int) -> str:
    """The name of the studio's camera that is left out: any, by the seed, but not in step with it."""
    return f"cam{int(np.random.SeedSequence([seed, cameras]).generate_state(1)[0]) % cameras:02d}"


def _files(places: Sequence[Path], suffixes: tuple[str, ...], what: str) -> list[Path]:
    """Files with these suffixes in the first of the places that has any, by name."""
    for place in places:
        found = sorted(f for f in place.iterdir() if f.suffix.lower() in suffixes) if place.is_dir() else []
        if found:
            return found
    tried = ", ".join(str(place) for place in places)
    raise CaptureError(f"expected {what} ({', '.join(suffixes)}) in one of {tried}, found none; check --performers")
