"""Performers and scenes drawn from a seed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from viewmend.data.synthetic.performer import TexturedMesh, skin
from viewmend.data.synthetic.procedural.body import build_body, hand_patches, shoe_patch
from viewmend.data.synthetic.procedural.clothing import (
    Cut,
    Tailor,
    Wearer,
    azimuths,
    limb_sheet,
    sample_cut,
    sample_outfit,
    torso_sheet,
)
from viewmend.data.synthetic.procedural.fabric import BoundMesh, Canvas, Image, Patch, assemble
from viewmend.data.synthetic.procedural.head import build_head, hair_patches, head_patches, sample_hair
from viewmend.data.synthetic.procedural.motion import MOTIONS, Motion, Tempo, sample_motion, seat_height
from viewmend.data.synthetic.procedural.props import HELD, STANDING, held_prop, standing_prop, stool
from viewmend.data.synthetic.procedural.skeleton import (
    SIDES,
    Physique,
    Skeleton,
    build_skeleton,
    sample_physique,
    solve,
)
from viewmend.geometry.mesh import Mesh

LAG_S = 0.12
"""Skirts and hair follow where the body was this long ago."""
BUSY_HANDS = ("jacks", "box", "reach", "run")


@dataclass(frozen=True)
class ProceduralPerson:
    """One person in motion."""

    bound: BoundMesh
    skeleton: Skeleton
    motion: Motion
    physique: Physique
    description: str

    def pose(self, time_s: float) -> TexturedMesh:
        """The person at this time, in seconds."""
        now, before = self.motion.stance(time_s), self.motion.stance(time_s - LAG_S)
        transforms = torch.from_numpy(solve(self.skeleton, now, before, LAG_S)).float()
        rest, joints, weights = self.bound.rest, self.bound.joints, self.bound.weights
        vertices, normals = skin(rest.mesh.vertices, rest.normals, joints, weights, transforms)
        return replace(rest, mesh=Mesh(vertices, rest.mesh.faces), normals=normals)


def draw_person(
    seeds: np.random.SeedSequence, tempo: Tempo, kind: str | None, holding: bool | None, center: tuple[float, float]
) -> ProceduralPerson:
    """Draw a person. `kind` fixes the motion, `holding` whether something is in a hand; `center` is x and z, metres."""
    body_rng, cloth_rng, hair_rng, motion_rng, prop_rng = (np.random.default_rng(s) for s in seeds.spawn(5))
    person = sample_physique(body_rng)
    outfit = sample_outfit(cloth_rng, person.femininity)
    hair = sample_hair(hair_rng, person.femininity, person.skin_rgb[0] < 0.6)
    skeleton = build_skeleton(person)
    body = build_body(person, skeleton)
    wearer = Wearer(body, skeleton, person.height_m)
    tailor = Tailor(wearer, outfit, sample_cut(outfit))
    bulk = 0.06 + 0.08 * max(person.weight, 0) + (0.10 if outfit.outer != "none" else 0.0)
    motion = sample_motion(motion_rng, person, skeleton, tempo, kind, bulk, center)
    patches = tailor.top() + tailor.bottom() + tailor.outer()
    head = build_head(person, skeleton)
    patches += head_patches(person, head, hair_rng, hair.color)
    patches += hair_patches(head, hair, body.torso, outfit.fabrics[1].colors[0])
    patches += _skin_patches(person, wearer, tailor.cut, hair_rng)
    patches += [shoe_patch(skeleton, person.height_m, side, outfit.shoes[0], outfit.shoes[1]) for side in SIDES]
    held = ""
    if (prop_rng.random() < 0.3 if holding is None else holding) and motion.score.kind not in BUSY_HANDS:
        thing, side = HELD[int(prop_rng.integers(len(HELD)))], SIDES[int(prop_rng.integers(2))]
        patches += held_prop(thing, prop_rng, body, skeleton, person.height_m, side)
        motion = motion.gripping(side)
        held = f" with a {thing}"
    sex = "woman" if person.femininity > 0.5 else "man"
    words = f"{sex}, {person.height_m:.2f} m, {hair.words}, {outfit.words}, {motion.score.kind} ({tempo}){held}"
    return ProceduralPerson(assemble(patches), skeleton, motion, person, words)


def _skin_patches(person: Physique, wearer: Wearer, cut: Cut, rng: np.random.Generator) -> list[Patch]:
    """Bare skin: neck and shoulders, arms, legs and hands; what cloth covers stays inside it."""
    H = person.height_m

    def paint(canvas: Canvas) -> Image:
        tone = 1 + 0.015 * canvas.noise(rng, 0.03, 0.03) + 0.012 * canvas.noise(rng, 0.004, 0.004)
        return np.clip(np.array(person.skin_rgb) * tone[..., None], 0, 1)

    around = azimuths(49)
    low, high = np.full_like(around, 0.73 * H), np.full_like(around, 0.893 * H)
    patches = [torso_sheet(wearer, wearer.body, low, high, around, paint, rows=24)]
    # Cloth covers what lies further in than a hand's breadth from its hem.
    arm, leg = max(cut.cuff - 0.15, -0.03), max(cut.leg - 0.12, 0.0)
    for i in (0, 1):
        grids = (8 + int(24 * (1 - arm)), 21), (8 + int(28 * (1 - leg)), 25)
        patches.append(limb_sheet(wearer, wearer.body, 1 + i, arm, 1.0, paint, grid=grids[0]))
        patches.append(limb_sheet(wearer, wearer.body, 3 + i, leg, 1.04, paint, grid=grids[1]))
    skin = paint(Canvas(0.1, 0.1))
    girth = 1.05 - 0.13 * person.femininity + 0.05 * person.weight
    for side in SIDES:
        patches += hand_patches(wearer.body, wearer.skeleton, H, side, skin, girth)
    return patches


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
        words += ", next to " + " and ".join(names)
    return ProceduralPerformer(tuple(people), assemble(patches).rest if patches else None, words)


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
