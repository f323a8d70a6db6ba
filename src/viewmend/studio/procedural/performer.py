"""Performers and scenes drawn from a seed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from viewmend.geometry.mesh import Mesh
from viewmend.studio.performer import TexturedMesh
from viewmend.studio.procedural.grounds import Tempo, seat_height
from viewmend.studio.procedural.motion import MOTIONS
from viewmend.studio.procedural.patches import BoundMesh, Patch, assemble
from viewmend.studio.procedural.person import ProceduralPerson, draw_person
from viewmend.studio.procedural.props import STANDING, standing_prop, stool

TEMPOS: tuple[Tempo, ...] = ("calm", "dance", "fast")
ROAMING = ("walk", "run", "sidestep")
"""Motions that need the floor for themselves."""


@dataclass(frozen=True)
class ProceduralPerformer:
    """One or two people and what stands around them. `pose` keeps nothing between calls."""

    people: tuple[ProceduralPerson, ...]
    things: TexturedMesh | None
    description: str

    def pose(self, time_s: float) -> TexturedMesh:
        """All of them at this time, in seconds."""
        parts = [person.pose(time_s) for person in self.people]
        if self.things is not None:
            parts.append(self.things)
        return parts[0] if len(parts) == 1 else merge(parts)


@dataclass(frozen=True, kw_only=True)
class PerformerStyle:
    """What of a performer or scene is fixed; None leaves it to the seed."""

    tempo: Tempo | None = None
    motion: str | None = None
    """One of those in `motion.MOTIONS`."""
    people: int | None = None
    """1 or 2, for scenes."""
    holding: bool | None = None
    """Whether something is held in a hand."""
    furniture: bool | None = None
    """Whether things stand around, for scenes (who sits has a stool anyway)."""


def procedural_scene(seed: int, *, style: PerformerStyle | None = None) -> ProceduralPerformer:
    """One or two clothed people in motion around the stage's centre, perhaps with things in their hands and around.

    The same seed and style give the same scene, bit for bit.

    Args:
        seed: any non-negative number; from 10000 on they are for tests, never for training.
        style: what to fix.

    Raises:
        ValueError: the style names a motion that does not exist, or another number of people than 1 or 2.
    """
    style = style or PerformerStyle()
    _check(style)
    rng = np.random.default_rng([seed, 77])
    chance = rng.random(3)
    count = style.people or (2 if chance[0] < 0.2 else 1)
    tempo: Tempo = style.tempo or TEMPOS[int(rng.integers(3))]
    angle = rng.uniform(0, 2 * np.pi)
    aside = np.array([np.sin(angle), np.cos(angle)]) * (0.46 if count == 2 else 0.0)
    people = []
    for i, seeds in enumerate(np.random.SeedSequence(seed).spawn(count)):
        kind = style.motion or _kind(rng, tempo, crowded=count == 2)
        x, z = (aside * (1 - 2 * i)).tolist()
        people.append(draw_person(seeds, tempo, kind, style.holding, (x, z)))
    patches, names = _seats(people, rng), []
    roams = any(person.motion.score.kind in ROAMING for person in people)
    if (chance[1] < 0.5 if style.furniture is None else style.furniture) and not roams:
        more, names = _furniture(rng, angle)
        patches += more
    words = " and ".join(person.description for person in people)
    if names:
        words += ", beside " + " and ".join(names)
    return ProceduralPerformer(tuple(people), still(assemble(patches)) if patches else None, words)


def _check(style: PerformerStyle) -> None:
    known = sorted({kind for kinds in MOTIONS.values() for kind in kinds})
    if style.motion is not None and style.motion not in known:
        raise ValueError(f"expected a motion among {known}, got {style.motion!r}; choose one of them")
    if style.people not in (None, 1, 2):
        raise ValueError(f"expected 1 or 2 people, got {style.people}; the stage holds no more")


def _kind(rng: np.random.Generator, tempo: Tempo, crowded: bool) -> str:
    kinds = [kind for kind in MOTIONS[tempo] if not (crowded and kind in ROAMING)]
    return kinds[int(rng.integers(len(kinds)))]


def _seats(people: list[ProceduralPerson], rng: np.random.Generator) -> list[Patch]:
    """A stool under everyone who sits."""
    patches: list[Patch] = []
    for person in people:
        score, center = person.motion.score, person.motion.center
        if score.kind == "sit":
            under = np.array([center[0], 0.0, center[1]])
            back = 0.03 * score.height_m * np.array([np.sin(score.heading), 0, np.cos(score.heading)])
            patches += stool(rng, under - back, score.heading, seat_height(score.height_m))
    return patches


def _furniture(rng: np.random.Generator, angle: float) -> tuple[list[Patch], list[str]]:
    """One or two things on the floor, off the line through two people."""
    patches: list[Patch] = []
    names: list[str] = []
    for i in range(int(rng.integers(1, 3))):
        kind = STANDING[int(rng.integers(len(STANDING)))]
        turn = angle + np.pi / 2 + i * np.pi + rng.uniform(-0.6, 0.6)
        at = rng.uniform(0.78, 0.95) * np.array([np.sin(turn), 0, np.cos(turn)])
        patches += standing_prop(kind, rng, at, float(rng.uniform(0, 6.3)))
        names.append(f"a {kind}")
    return patches, names


def merge(parts: Sequence[TexturedMesh]) -> TexturedMesh:
    """All parts in one mesh; their textures stay separate."""
    vertices, faces, textures, first, layer = [], [], [], 0, 0
    for part in parts:
        vertices.append(part.mesh.vertices)
        faces.append(part.mesh.faces + first)
        textures.append(part.texture_of_face + layer)
        first, layer = first + len(part.mesh.vertices), layer + len(part.textures)
    return TexturedMesh(
        Mesh(torch.cat(vertices), torch.cat(faces)),
        torch.cat([part.normals for part in parts]),
        torch.cat([part.uv for part in parts]),
        torch.cat(textures),
        tuple(texture for part in parts for texture in part.textures),
    )


def still(bound: BoundMesh) -> TexturedMesh:
    """A mesh that stays in its bind pose: what stands on the floor."""
    texture = torch.zeros(len(bound.mesh.faces), dtype=torch.int64)
    return TexturedMesh(bound.mesh, bound.normals, bound.uv, texture, (bound.atlas,))
