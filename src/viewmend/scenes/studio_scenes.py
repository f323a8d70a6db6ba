"""Studio scenes: the fixed sets P and Q, their long versions with a whole window of past frames, and turning people."""

import csv
import hashlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np

from viewmend.data.errors import CaptureError
from viewmend.geometry.cameras import Cameras, concatenate_cameras
from viewmend.geometry.mesh import Mesh
from viewmend.models.paper.config import paper
from viewmend.models.paper.context import window_times
from viewmend.rendering.view import select_closest
from viewmend.scenes.held_out import PROCEDURAL_SEEDS, TEST_FOLDER, LeaveOneOutFrame, LeaveOneOutScene
from viewmend.scenes.true_visibility import TrueSurface, backward_flow, surface_seen
from viewmend.studio.procedural import PerformerStyle, procedural_scene
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import MultiViewFrame, Silhouettes

P_SEEDS = PROCEDURAL_SEEDS["test"][:30]
RINGS = (12, 8)
"""Cameras of the two rigs, the left-out one among them: a usual ring, and a sparse one."""
TEMPOS = ("calm", "dance", "fast")
Q_SEEDS = PROCEDURAL_SEEDS["test"][10000:]
"""Seeds of lights, rig and the part of the motion that is used."""
FRAMES = 10
"""This many frames of each scene are scored."""
SIZE_PX = 512
"""The longer side of the images, pixels."""
LONG_FRAMES = 41
"""Frames of the long sets: the last `FRAMES` are scored, and at the first of these the paper's
window is whole."""
TURN_SEEDS = PROCEDURAL_SEEDS["test"][100:124]
TURN_RINGS = (8, 7)
"""Rings in which holes are a few percent of the subject, and many of their pixels are seen
only in the past."""
RIG_SEEDS = PROCEDURAL_SEEDS["test"][300:700]
"""Seeds of candidates for the procedural scenes of R48 and R34."""
RIG_PERFORMER_SEEDS = PROCEDURAL_SEEDS["test"][20000:]
"""Seeds of lights, rig and the part of the motion of the glTF scenes of R48 and R34."""
RIG_TIMES = tuple(sorted(window_times(30, paper())))
"""Frames of R48 and R34: the paper's window of frame 30, which is the one that is scored."""
RIG_COLOURED = 8
"""Cameras with images in the scored frame of R48 and R34: as many as models that sample along rays read."""
COLOURED_BEFORE = 4
"""Cameras with images in earlier frames: the three source cameras and one more, since the hull
decides which three."""
TURNS: tuple[tuple["Tempo", str], ...] = (("calm", "turn"), ("dance", "spin"))

Background = Literal["black", "stage"]
Tempo = Literal["calm", "dance", "fast"]
RigName = Literal["R48", "R34"]
RIGS: dict[RigName, tuple[int, Literal["layers", "dome"]]] = {"R48": (48, "layers"), "R34": (34, "dome")}
"""Cameras of the rigs of the paper's two data sets, and how they are placed."""


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
    times: tuple[int, ...] = ()
    """Frames that are drawn; () for all."""
    coloured: int | None = None
    """Cameras whose images are drawn in the last frame, those closest to the held-out one; all
    others give their masks alone. None draws all images."""

    @property
    def definition(self) -> str:
        """The studio's config without paths, and what else matters."""
        config = replace(self.config, performers=None, motions=None)
        longer = (self.scored_from, self.motion) if self.scored_from or self.motion else ()
        sparse = (self.times, self.coloured) if self.times or self.coloured is not None else ()
        return repr((config, self.held, self.tempo, self.files_sha256, *longer, *sparse))

    def studio(self) -> Studio:
        """The studio with its people: frames of all cameras, the one that is left out among them."""
        config = self.config
        if self.tempo is None:
            return Studio(config)
        alone: dict[str, Any] = (
            {} if self.motion is None else {"motion": self.motion, "people": 1, "furniture": False}
        )
        return Studio(config, procedural_scene(config.seed, style=PerformerStyle(tempo=self.tempo, **alone)))

    def frames(self) -> Iterator[LeaveOneOutFrame]:
        """Renders them, one at a time. Of those before the first that is scored, only what a context needs is made."""
        studio = self.studio()
        others = studio.cameras.select([name for name in studio.cameras.names if name != self.held])
        target = studio.true_cameras.select([self.held])
        times = self.times or tuple(range(self.config.frames))
        closest = self._closest_first(studio, times[-1], others, target)
        before: MultiViewFrame | None = None
        surfaces: dict[int, TrueSurface] = {}
        for time in times:
            scored = time >= self.scored_from
            drawn, carving = self._draw(studio, time, closest, scored)
            truth = studio.truth(target, time)
            frame = LeaveOneOutFrame(replace(drawn, depth=None), truth, None, carving)
            mesh = studio.scene(time).mesh
            if self.scored_from:
                surfaces[time] = _true_surface(mesh, drawn, carving, scored)
                surfaces.pop(time - paper().window - 1, None)
                if scored:
                    seen = surface_seen(surfaces, window_times(time, paper()), mesh, target)
                    frame = replace(frame, seen=seen)
            if scored and before is not None and before.depth is not None:
                flow_px = backward_flow(mesh, studio.scene(before.time).mesh, before.depth[0], target)
                frame = replace(frame, backward_flow_px=flow_px)
            yield frame
            before = truth

    def _closest_first(self, studio: Studio, time: int, others: Cameras, target: Cameras) -> tuple[str, ...]:
        """Names of the input cameras, the closest to the held-out one first."""
        center = studio.scene(time).mesh.vertices.mean(0)
        return select_closest(target, others, center, len(others))

    def _draw(
        self, studio: Studio, time: int, closest: tuple[str, ...], scored: bool
    ) -> tuple[MultiViewFrame, Silhouettes | None]:
        """The images of the input cameras that colour the view, and the masks of the other input cameras."""
        count = self.coloured if scored or self.coloured is None else min(self.coloured, COLOURED_BEFORE)
        drawn = set(closest[:count])
        names = [name for name in studio.cameras.names if name in drawn]
        rest = [name for name in studio.cameras.names if name in set(closest) - drawn]
        return studio.read(time, names), studio.silhouettes(time, rest) if rest else None


def _true_surface(
    mesh: Mesh, drawn: MultiViewFrame, carving: Silhouettes | None, scored: bool
) -> TrueSurface:
    """The surface of a frame, as seen by the cameras that are coloured, and when it is scored by all others."""
    if carving is None or not scored:
        return TrueSurface.of(mesh, drawn.cameras, drawn.depth)
    return TrueSurface.of(mesh, concatenate_cameras([drawn.cameras, carving.cameras]))


def procedural_set(
    frames: int = FRAMES, size_px: int = SIZE_PX, background: Background = "black"
) -> tuple[StudioScene, ...]:
    """P: 30 procedural scenes; the two rigs and three tempos alternate, so that each pair occurs five times.

    With a stage as the background it is P-stage: the same people, for models that are not given masks.
    """
    name = "P" if background == "black" else f"P-{background}"
    scenes = []
    for n, seed in enumerate(P_SEEDS):
        cameras = RINGS[n % 2]
        tempo = TEMPOS[n % 3]
        config = StudioConfig(
            seed=seed, cameras=cameras, frames=frames, size_px=size_px, background=background
        )
        scenes.append(_scene(f"{name}-{seed}", name, cameras, tempo, config, tempo=tempo))
    return tuple(scenes)


def _scene(name: str, set: str, cameras: int, style: str, config: StudioConfig, **more: Any) -> StudioScene:
    """A scene seen by a ring of cameras. Its seed determines which one is left out."""
    held = _held_out_camera(config.seed, cameras)
    return StudioScene(
        name=name, set=set, rig=f"ring of {cameras}", style=style, config=config, held=held, **more
    )


def _held_out_camera(seed: int, cameras: int) -> str:
    """The camera that a seed leaves out."""
    return f"cam{int(np.random.SeedSequence([seed, cameras]).generate_state(1)[0]) % cameras:02d}"


def turning_set(size_px: int = SIZE_PX) -> tuple[StudioScene, ...]:
    """P-turn: 24 people who turn or spin on an empty stage, seen by two rings; rigs and motions alternate.

    Some missing pixels are seen by no source view now, but were seen some frames ago.
    """
    scenes = []
    for n, seed in enumerate(TURN_SEEDS):
        cameras = TURN_RINGS[n % 2]
        tempo, motion = TURNS[n // 2 % 2]
        config = StudioConfig(seed=seed, cameras=cameras, frames=LONG_FRAMES, size_px=size_px)
        moving = {"tempo": tempo, "motion": motion, "scored_from": LONG_FRAMES - FRAMES}
        scenes.append(_scene(f"P-turn-{seed}", "P-turn", cameras, motion, config, **moving))
    return tuple(scenes)


def rig_set(
    name: RigName, folder: Path | None = None, motions: Path | None = None, size_px: int = SIZE_PX
) -> tuple[StudioScene, ...]:
    """R48, 48 cameras in three layers as in DNA-Rendering, or R34, a dome of 34 cameras as in RIFTCast's data set.

    They show procedural people, and with a `folder` the glTF people of set Q, each with every
    motion. One camera is left out, all others carve the hull, and the three closest colour the view
    of the one scored frame. The camera is chosen so that at least 200 hole pixels lie inside its
    true mask at 512 x 512 (`rig_views.csv`, which research/choose_rig_views.py makes). Scenes
    without such a view are left out. If the file knows none of the glTF people, all their scenes
    are used, and the seed chooses the camera.
    """
    text = (files("viewmend.scenes") / "rig_views.csv").read_text(encoding="utf-8")
    held = {row["scene"]: row["held"] for row in csv.DictReader(text.splitlines())}
    scenes = [scene for scene in procedural_rig_scenes(name, size_px) if scene.name in held]
    if folder is not None:
        people = performer_rig_scenes(name, folder, motions, size_px)
        scenes += [scene for scene in people if scene.name in held] or people
    return tuple(replace(scene, held=held.get(scene.name, scene.held)) for scene in scenes)


def procedural_rig_scenes(name: RigName, size_px: int = SIZE_PX) -> tuple[StudioScene, ...]:
    """Candidates for `rig_set`: one scene for each of `RIG_SEEDS`, whose camera the seed chooses."""
    scenes = []
    for n, seed in enumerate(RIG_SEEDS):
        scene = _rig_scene(name, f"{name}-{seed}", seed, size_px)
        tempo = TEMPOS[n % 3]
        scenes.append(replace(scene, style=tempo, tempo=tempo))
    return tuple(scenes)


def performer_rig_scenes(
    name: RigName, folder: Path, motions: Path | None = None, size_px: int = SIZE_PX
) -> tuple[StudioScene, ...]:
    """Candidates for `rig_set`: every glTF character with every motion; CaptureError without either."""
    scenes = []
    for seed, (person, clip, sha256) in zip(
        RIG_PERFORMER_SEEDS, _people_and_clips(folder, motions), strict=False
    ):
        scene = _rig_scene(name, f"{name}-{person.stem}-{clip.stem}", seed, size_px)
        config = replace(scene.config, performers=person, motions=clip)
        scenes.append(replace(scene, style=clip.stem, config=config, files_sha256=sha256))
    return tuple(scenes)


def _rig_scene(set: RigName, name: str, seed: int, size_px: int) -> StudioScene:
    """A scene of R48 or R34, of procedural people."""
    cameras, placed = RIGS[set]
    frames = RIG_TIMES[-1] + 1
    return StudioScene(
        name=name,
        set=set,
        rig=f"{cameras} cameras, {placed}",
        style="",
        config=StudioConfig(seed=seed, cameras=cameras, rig=placed, frames=frames, size_px=size_px),
        held=_held_out_camera(seed, cameras),
        scored_from=RIG_TIMES[-1],
        times=RIG_TIMES,
        coloured=RIG_COLOURED,
    )


def lengthen(scenes: Sequence[StudioScene]) -> tuple[StudioScene, ...]:
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
    scenes = []
    for seed, (person, clip, hashes) in zip(Q_SEEDS, _people_and_clips(folder, motions), strict=False):
        for cameras in RINGS:
            config = StudioConfig(seed=seed, cameras=cameras, frames=frames, size_px=size_px)
            config = replace(config, performers=person, motions=clip)
            name = f"Q-{person.stem}-{clip.stem}-{cameras}"
            scenes.append(_scene(name, "Q", cameras, clip.stem, config, files_sha256=hashes))
    return tuple(scenes)


def _people_and_clips(folder: Path, motions: Path | None) -> list[tuple[Path, Path, tuple[str, str]]]:
    """Every character with every motion, and the hashes of both files."""
    people = _files((folder / TEST_FOLDER, folder), (".glb", ".gltf"), "characters")
    places = (motions,) if motions else (folder / "motions" / TEST_FOLDER, folder / "motions", folder)
    clips = _files(places, (".bvh",), "motions")
    sha256 = {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in (*people, *clips)}
    return [
        (person, clip, (sha256[person], sha256[clip])) for person, clip in itertools.product(people, clips)
    ]


def _files(places: Sequence[Path], suffixes: tuple[str, ...], what: str) -> list[Path]:
    """Files with these suffixes in the first of the places that has any, by name."""
    for place in places:
        found = sorted(f for f in place.iterdir() if f.suffix.lower() in suffixes) if place.is_dir() else []
        if found:
            return found
    tried = ", ".join(str(place) for place in places)
    raise CaptureError(
        f"expected {what} ({', '.join(suffixes)}) in one of {tried}, found none; check --performers"
    )
