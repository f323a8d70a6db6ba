"""Scenes of the studio: the fixed sets P and Q."""

import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from viewmend.capture.errors import CaptureError
from viewmend.leave_one_out.scenes import LeaveOneOut, LeaveOneOutFrame, LeaveOneOutScene
from viewmend.leave_one_out.splits import PROCEDURAL_SEEDS, TEST_FOLDER
from viewmend.leave_one_out.true_motion import backward_flow
from viewmend.studio.procedural import PerformerStyle, procedural_scene
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.views import MultiViewFrame

P_SEEDS = PROCEDURAL_SEEDS["test"][:30]
RINGS = (12, 8)
"""Cameras of the two rigs, the left-out one among them: a usual ring, and a sparse one."""
TEMPOS = ("calm", "dance", "fast")
Q_SEEDS = PROCEDURAL_SEEDS["test"][10000:]
"""Seeds of lights, rig and the part of the motion that is shown."""
FRAMES, SIZE_PX = 10, 512

Background = Literal["black", "stage"]
Tempo = Literal["calm", "dance", "fast"]


@dataclass(frozen=True, kw_only=True)
class StudioScene(LeaveOneOutScene):
    """A scene of the studio, perfectly calibrated; the truth is exact."""

    config: StudioConfig
    tempo: Tempo | None = None
    """How fast procedural people move; None leaves it to the seed."""
    files_sha256: tuple[str, ...] = ()
    """Hashes of the character's and the motion's files; () for procedural people."""

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

    def frames(self, device: str) -> Iterator[LeaveOneOutFrame]:
        """Renders them, one at a time."""
        studio = self.studio(device)
        before: MultiViewFrame | None = None
        for time in range(self.config.frames):
            frame = LeaveOneOut({time: studio.read(time)}).frame(self.held, time)
            if before is not None and before.depth is not None:
                now, then = (studio.scene(t).mesh for t in (time, time - 1))
                flow_px = backward_flow(now, then, before.depth[0], frame.truth.cameras)
                frame = replace(frame, backward_flow_px=flow_px)
            yield frame
            before = frame.truth


def procedural_set(
    frames: int = FRAMES, size_px: int = SIZE_PX, background: Background = "black"
) -> tuple[StudioScene, ...]:
    """P: 30 procedural scenes; both rigs and the three tempos take turns, so that each pair comes five times.

    With a stage as the background it is P-stage: the same people, for models that are not given masks.
    """
    name = "P" if background == "black" else f"P-{background}"
    scenes = []
    for n, seed in enumerate(P_SEEDS):
        cameras, tempo = RINGS[n % 2], TEMPOS[n % 3]
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
    people = _files((folder / TEST_FOLDER, folder), (".glb", ".gltf"), "characters")
    clips = _files(
        (motions,) if motions else (folder / "motions" / TEST_FOLDER, folder / "motions", folder), (".bvh",), "motions"
    )
    sha256 = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in (*people, *clips)}
    scenes = []
    for seed, (person, clip) in zip(Q_SEEDS, itertools.product(people, clips), strict=False):
        for cameras in RINGS:
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
