"""Studio scenes: the fixed sets P and Q, their long versions with a whole window of past frames, and turning people."""

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from viewmend.data.errors import CaptureError
from viewmend.models.paper.config import paper
from viewmend.models.paper.context import window_times
from viewmend.scenes.held_out import PROCEDURAL_SEEDS, TEST_FOLDER, LeaveOneOut, LeaveOneOutFrame, LeaveOneOutScene
from viewmend.scenes.true_visibility import TrueSurface, backward_flow, surface_seen
from viewmend.studio.procedural import PerformerStyle, procedural_scene
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import MultiViewFrame

P_SEEDS = PROCEDURAL_SEEDS["test"][:30]
RINGS = (12, 8)
"""Cameras of the two rigs, the left-out one among them: a usual ring, and a sparse one."""
TEMPOS = ("calm", "dance", "fast")
Q_SEEDS = PROCEDURAL_SEEDS["test"][10000:]
"""Seeds of lights, rig and the part of the motion that is used."""
FRAMES, SIZE_PX = 10, 512
LONG_FRAMES = 41
"""Frames of the long sets: the last `FRAMES` are scored, and at the first of these the paper's window is whole."""
TURN_SEEDS = PROCEDURAL_SEEDS["test"][100:124]
TURN_RINGS = (8, 7)
"""Rings in which holes are a few percent of the subject, and many of their pixels are seen only in the past."""
TURNS: tuple[tuple["Tempo", str], ...] = (("calm", "turn"), ("dance", "spin"))

Background = Literal["black", "stage"]
Tempo = Literal["calm", "dance", "fast"]


@dataclass(frozen=True, kw_only=True)
class StudioScene(LeaveOneOutScene):
    """A scene of the studio, perfectly calibrated; the truth is exact."""

    config: StudioConfig
    tempo: Tempo | None = None
    """How fast procedural people move; None leaves it to the seed."""
    motion: str | None = None
    """How procedural people move, one person alone on an empty stage; None leaves all that to the seed."""
    files_sha256: tuple[str, ...] = ()
    """Hashes of the character's and the motion's files; () for procedural people."""

    @property
    def definition(self) -> str:
        """The studio's config without paths, and what else matters."""
        config = replace(self.config, performers=None, motions=None)
        longer = (self.scored_from, self.motion) if self.scored_from or self.motion else ()
        return repr((config, self.held, self.tempo, self.files_sha256, *longer))

    def studio(self) -> Studio:
        """The studio with its people: frames of all cameras, the one that is left out among them."""
        config = self.config
        if self.tempo is None:
            return Studio(config)
        alone = {} if self.motion is None else {"motion": self.motion, "people": 1, "furniture": False}
        return Studio(config, procedural_scene(config.seed, style=PerformerStyle(tempo=self.tempo, **alone)))

    def frames(self) -> Iterator[LeaveOneOutFrame]:
        """Renders them, one at a time. Of those before the first that is scored, only what a context needs is made."""
        studio = self.studio()

        def true_view(held: str, time: int) -> MultiViewFrame:
            return studio.truth(studio.true_cameras.select([held]), time)

        before: MultiViewFrame | None = None
        surfaces: dict[int, TrueSurface] = {}
        for time in range(self.config.frames):
            drawn = studio.read(time)
            frame = LeaveOneOut({time: drawn}, true_view=true_view).frame(self.held, time)
            scored = time >= self.scored_from
            if self.scored_from:
                mesh = studio.scene(time).mesh
                surfaces[time] = TrueSurface.of(drawn.without((self.held,)), mesh)
                surfaces.pop(time - paper().window - 1, None)
                if scored:
                    seen = surface_seen(surfaces, window_times(time, paper()), mesh, frame.truth.cameras)
                    frame = replace(frame, seen=seen)
            if scored and before is not None and before.depth is not None:
                now, then = (studio.scene(t).mesh for t in (time, time - 1))
                flow_px = backward_flow(now, then, before.depth[0], frame.truth.cameras)
                frame = replace(frame, backward_flow_px=flow_px)
            yield frame
            before = frame.truth


def procedural_set(
    frames: int = FRAMES, size_px: int = SIZE_PX, background: Background = "black"
) -> tuple[StudioScene, ...]:
    """P: 30 procedural scenes; the two rigs and three tempos alternate, so that each pair occurs five times.

    With a stage as the background it is P-stage: the same people, for models that are not given masks.
    """
    name = "P" if background == "black" else f"P-{background}"
    scenes = []
    for n, seed in enumerate(P_SEEDS):
        cameras, tempo = RINGS[n % 2], TEMPOS[n % 3]
        config = StudioConfig(seed=seed, cameras=cameras, frames=frames, size_px=size_px, background=background)
        scenes.append(_scene(f"{name}-{seed}", name, cameras, tempo, config, tempo=tempo))
    return tuple(scenes)


def _scene(name: str, set: str, cameras: int, style: str, config: StudioConfig, **more: Any) -> StudioScene:
    """A scene seen by a ring of cameras, of which the seed leaves out one: any, but not in step with the seed."""
    held = f"cam{int(np.random.SeedSequence([config.seed, cameras]).generate_state(1)[0]) % cameras:02d}"
    return StudioScene(name=name, set=set, rig=f"ring of {cameras}", style=style, config=config, held=held, **more)


def turning_set(size_px: int = SIZE_PX) -> tuple[StudioScene, ...]:
    """P-turn: 24 people who turn or spin on an empty stage, seen by two rings; rigs and motions alternate.

    Some missing pixels are seen by no source view now, but were seen some frames ago.
    """
    scenes = []
    for n, seed in enumerate(TURN_SEEDS):
        cameras, (tempo, motion) = TURN_RINGS[n % 2], TURNS[n // 2 % 2]
        config = StudioConfig(seed=seed, cameras=cameras, frames=LONG_FRAMES, size_px=size_px)
        moving = {"tempo": tempo, "motion": motion, "scored_from": LONG_FRAMES - FRAMES}
        scenes.append(_scene(f"P-turn-{seed}", "P-turn", cameras, motion, config, **moving))
    return tuple(scenes)


def lengthened(scenes: Sequence[StudioScene]) -> tuple[StudioScene, ...]:
    """P-long of P, Q-long of Q: the same scenes of `LONG_FRAMES` frames, whose last `FRAMES` are scored."""
    return tuple(
        replace(
            scene,
            name=scene.name.replace(scene.set, f"{scene.set}-long", 1),
            set=f"{scene.set}-long",
            config=replace(scene.config, frames=LONG_FRAMES),
            scored_from=LONG_FRAMES - FRAMES,
        )
        for scene in scenes
    )


def performer_set(
    folder: Path, motions: Path | None = None, frames: int = FRAMES, size_px: int = SIZE_PX
) -> tuple[StudioScene, ...]:
    """Q: every character with every motion, each with both rigs; CaptureError without characters or motions."""
    people = _files((folder / TEST_FOLDER, folder), (".glb", ".gltf"), "characters")
    places = (motions,) if motions else (folder / "motions" / TEST_FOLDER, folder / "motions", folder)
    clips = _files(places, (".bvh",), "motions")
    sha256 = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in (*people, *clips)}
    scenes = []
    for seed, (person, clip) in zip(Q_SEEDS, itertools.product(people, clips), strict=False):
        for cameras in RINGS:
            config = StudioConfig(seed=seed, cameras=cameras, frames=frames, size_px=size_px)
            config = replace(config, performers=person, motions=clip)
            hashes = (sha256[person], sha256[clip])
            name = f"Q-{person.stem}-{clip.stem}-{cameras}"
            scenes.append(_scene(name, "Q", cameras, clip.stem, config, files_sha256=hashes))
    return tuple(scenes)


def _files(places: Sequence[Path], suffixes: tuple[str, ...], what: str) -> list[Path]:
    """Files with these suffixes in the first of the places that has any, by name."""
    for place in places:
        found = sorted(f for f in place.iterdir() if f.suffix.lower() in suffixes) if place.is_dir() else []
        if found:
            return found
    tried = ", ".join(str(place) for place in places)
    raise CaptureError(f"expected {what} ({', '.join(suffixes)}) in one of {tried}, found none; check --performers")
