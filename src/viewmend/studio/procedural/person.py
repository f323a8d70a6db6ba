"""One person: body, clothes, hair and what they hold, bound to a skeleton and moved by a motion."""

from dataclasses import dataclass

import numpy as np
import torch

from viewmend.geometry.mesh import Mesh
from viewmend.studio.performer import TexturedMesh
from viewmend.studio.procedural.body import build_body
from viewmend.studio.procedural.clothing import Tailor
from viewmend.studio.procedural.extremities import hand_patches, shoe_patch
from viewmend.studio.procedural.fabric import Canvas, Image
from viewmend.studio.procedural.grounds import Tempo
from viewmend.studio.procedural.hair import hair_patches, sample_hair
from viewmend.studio.procedural.head import build_head, head_patches
from viewmend.studio.procedural.motion import Motion, sample_motion
from viewmend.studio.procedural.outfit import Cut, sample_cut, sample_outfit
from viewmend.studio.procedural.patches import BoundMesh, Patch, assemble
from viewmend.studio.procedural.physique import Physique, build_skeleton, sample_physique
from viewmend.studio.procedural.props import HELD, held_prop
from viewmend.studio.procedural.sheets import Wearer, azimuths, limb_sheet, torso_sheet
from viewmend.studio.procedural.skeleton import SIDES, Skeleton
from viewmend.studio.procedural.stance import solve
from viewmend.studio.skinning import skin_with_normals

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
        bound = self.bound
        vertices, normals = skin_with_normals(
            bound.mesh.vertices, bound.normals, bound.joints, bound.weights, transforms
        )
        texture = torch.zeros(len(bound.mesh.faces), dtype=torch.int64)
        return TexturedMesh(Mesh(vertices, bound.mesh.faces), normals, bound.uv, texture, (bound.atlas,))


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
