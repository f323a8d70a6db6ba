"""Samples performers and scenes by seed."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from viewmend.geometry.mesh import Mesh
from viewmend.studio.performer import BoundMesh, TexturedMesh
from viewmend.studio.procedural.body import build_body, shoe_patch
from viewmend.studio.procedural.clothing import Tailor, sample_cut, sample_outfit
from viewmend.studio.procedural.fabric import Patch, assemble
from viewmend.studio.procedural.head import build_head, hair_patches, head_patches, sample_hair
from viewmend.studio.procedural.motion import MOTIONS, SEAT, Motion, Tempo, sample_motion
from viewmend.studio.procedural.props import HELD, STANDING, held_prop, standing_prop, stool
from viewmend.studio.procedural.skeleton import SIDES, Physique, Skeleton, build_skeleton, sample_physique

LAG_S = 0.12
"""Skirts and hair lag behind the body by this many seconds."""
BUSY_HANDS = ("jacks", "box", "reach", "run")
ROAMING = ("walk", "run", "sidestep")
"""Motions that need the floor to themselves."""


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
        now = self.motion.stance(time_s)
        before = self.motion.stance(time_s - LAG_S)
        transforms = torch.from_numpy(now.solve(self.skeleton, before, LAG_S)).float()
        return self.bound.skin(transforms)


def draw_person(
    seeds: np.random.SeedSequence,
    tempo: Tempo,
    kind: str | None,
    holding: bool | None,
    center: tuple[float, float],
) -> ProceduralPerson:
    """Sample a person. `kind` fixes the motion, `holding` whether a hand holds something.

    `center` is x and z, metres.
    """
    body_rng, cloth_rng, hair_rng, motion_rng, prop_rng = (np.random.default_rng(s) for s in seeds.spawn(5))
    person = sample_physique(body_rng)
    outfit = sample_outfit(cloth_rng, person.femininity)
    hair = sample_hair(hair_rng, person.femininity, person.skin_rgb[0] < 0.6)
    skeleton = build_skeleton(person)
    body = build_body(person, skeleton)
    tailor = Tailor(body, outfit, sample_cut(outfit))
    bulk = 0.06 + 0.08 * max(person.weight, 0) + (0.10 if outfit.outer != "none" else 0.0)
    motion = sample_motion(motion_rng, person, skeleton, tempo, kind, bulk, center)
    patches = tailor.top() + tailor.bottom() + tailor.outer()
    head = build_head(person, skeleton)
    patches += head_patches(person, head, hair_rng, hair.color)
    patches += hair_patches(head, hair, body.torso, outfit.fabrics[1].colors[0])
    patches += tailor.skin(person, hair_rng)
    patches += [shoe_patch(body, side, outfit.shoes[0], outfit.shoes[1]) for side in SIDES]
    held = ""
    if (prop_rng.random() < 0.3 if holding is None else holding) and motion.score.kind not in BUSY_HANDS:
        thing = HELD[int(prop_rng.integers(len(HELD)))]
        side = SIDES[int(prop_rng.integers(2))]
        patches += held_prop(thing, prop_rng, body, side)
        motion = replace(motion, grip=side)
        held = f" with a {thing}"
    sex = "woman" if person.femininity > 0.5 else "man"
    words = (
        f"{sex}, {person.height_m:.2f} m, {hair.words}, {outfit.words}, {motion.score.kind} ({tempo}){held}"
    )
    return ProceduralPerson(assemble(patches), skeleton, motion, person, words)


@dataclass(frozen=True)
class ProceduralPerformer:
    """One or two people and the objects around them. `pose` keeps no state between calls."""

    people: tuple[ProceduralPerson, ...]
    things: TexturedMesh | None
    description: str

    def pose(self, time_s: float) -> TexturedMesh:
        """All people and objects at this time, in seconds, as one mesh; their textures stay separate."""
        parts = [person.pose(time_s) for person in self.people]
        if self.things is not None:
            parts.append(self.things)
        if len(parts) == 1:
            return parts[0]
        first = 0
        layer = 0
        faces = []
        textures = []
        for part in parts:
            faces.append(part.mesh.faces + first)
            textures.append(part.texture_of_face + layer)
            first = first + len(part.mesh.vertices)
            layer = layer + len(part.textures)
        vertices, normals, uv = zip(
            *((part.mesh.vertices, part.normals, part.uv) for part in parts), strict=True
        )
        mesh = Mesh(torch.cat(vertices), torch.cat(faces))
        every = tuple(texture for part in parts for texture in part.textures)
        return TexturedMesh(mesh, torch.cat(normals), torch.cat(uv), torch.cat(textures), every)


@dataclass(frozen=True, kw_only=True)
class PerformerStyle:
    """The properties of a performer or scene that are fixed; None leaves them to the seed."""

    tempo: Tempo | None = None
    motion: str | None = None
    """One of those in `motion.MOTIONS`."""
    people: int | None = None
    """1 or 2, for scenes."""
    holding: bool | None = None
    """Whether a hand holds something."""
    furniture: bool | None = None
    """Whether objects stand around, for scenes; a sitting person always has a stool."""


def procedural_scene(seed: int, *, style: PerformerStyle | None = None) -> ProceduralPerformer:
    """Sample one or two clothed people in motion around the stage's centre, perhaps with objects.

    The same seed and style give the same scene, bit for bit.

    Raises:
        ValueError: the style names a motion that does not exist, or another number of people than 1 or 2.
    """
    style = style or PerformerStyle()
    known = sorted({kind for kinds in MOTIONS.values() for kind in kinds})
    if style.motion is not None and style.motion not in known:
        raise ValueError(f"expected a motion among {known}, got {style.motion!r}; choose one of them")
    if style.people not in (None, 1, 2):
        raise ValueError(f"expected 1 or 2 people, got {style.people}; the stage holds no more")
    rng = np.random.default_rng([seed, 77])
    chance = rng.random(3)
    count = style.people or (2 if chance[0] < 0.2 else 1)
    tempo: Tempo = style.tempo or list(MOTIONS)[int(rng.integers(3))]
    angle = rng.uniform(0, 2 * np.pi)
    aside = np.array([np.sin(angle), np.cos(angle)]) * (0.46 if count == 2 else 0.0)
    people = []
    for i, seeds in enumerate(np.random.SeedSequence(seed).spawn(count)):
        kinds = [kind for kind in MOTIONS[tempo] if count == 1 or kind not in ROAMING]
        kind = style.motion or kinds[int(rng.integers(len(kinds)))]
        x, z = (aside * (1 - 2 * i)).tolist()
        people.append(draw_person(seeds, tempo, kind, style.holding, (x, z)))
    patches: list[Patch] = []
    for person in people:
        score = person.motion.score
        if score.kind == "sit":
            under = np.array([person.motion.center[0], 0.0, person.motion.center[1]])
            back = 0.03 * score.height_m * np.array([np.sin(score.heading), 0, np.cos(score.heading)])
            patches += stool(rng, under - back, score.heading, SEAT * score.height_m)
    words = " and ".join(person.description for person in people)
    roams = any(person.motion.score.kind in ROAMING for person in people)
    if (chance[1] < 0.5 if style.furniture is None else style.furniture) and not roams:
        more, names = _furniture(rng, angle)
        patches += more
        words += ", next to " + " and ".join(names)
    return ProceduralPerformer(tuple(people), assemble(patches).rest if patches else None, words)


def _furniture(rng: np.random.Generator, angle: float) -> tuple[list[Patch], list[str]]:
    """Put one or two objects on the floor, off the line through two people."""
    patches = []
    names = []
    for i in range(int(rng.integers(1, 3))):
        kind = STANDING[int(rng.integers(len(STANDING)))]
        turn = angle + np.pi / 2 + i * np.pi + rng.uniform(-0.6, 0.6)
        at = rng.uniform(0.78, 0.95) * np.array([np.sin(turn), 0, np.cos(turn)])
        patches += standing_prop(kind, rng, at, float(rng.uniform(0, 6.3)))
        names.append(f"a {kind}")
    return patches, names
