"""Performers and scenes drawn from a seed."""

from dataclasses import dataclass

import numpy as np
import torch

from viewmend.capture.studio.performer import Performer, TexturedMesh
from viewmend.capture.studio.procedural.body import build_body
from viewmend.capture.studio.procedural.clothing import Cut, Tailor, sample_cut, sample_outfit
from viewmend.capture.studio.procedural.extremities import hand_patches, shoe_patch
from viewmend.capture.studio.procedural.fabric import Canvas, Image
from viewmend.capture.studio.procedural.grounds import Tempo
from viewmend.capture.studio.procedural.hair import hair_patches, sample_hair
from viewmend.capture.studio.procedural.head import build_head, head_patches
from viewmend.capture.studio.procedural.motion import Motion, sample_motion
from viewmend.capture.studio.procedural.patches import BoundMesh, Patch, assemble
from viewmend.capture.studio.procedural.physique import Physique, build_skeleton, sample_physique
from viewmend.capture.studio.procedural.sheets import Wearer, azimuths, limb_sheet, torso_sheet
from viewmend.capture.studio.procedural.skeleton import SIDES, Skeleton
from viewmend.capture.studio.procedural.stance import solve
from viewmend.capture.studio.skinning import skin_with_normals
from viewmend.geometry.mesh import Mesh


@dataclass(frozen=True, kw_only=True)
class PerformerStyle:
    """What of a performer is fixed; None leaves it to the seed."""

    tempo: Tempo | None = None
    motion: str | None = None
    """One of `motion.MOTIONS`."""


@dataclass(frozen=True)
class ProceduralPerformer:
    """One person in motion. `pose` skins the bind mesh; it keeps nothing between calls."""

    bound: BoundMesh
    skeleton: Skeleton
    motion: Motion
    description: str

    def pose(self, time_s: float) -> TexturedMesh:
        """The person at this time, in seconds."""
        elapsed = 0.12
        stance = self.motion.stance(time_s)
        world_from_bind = solve(self.skeleton, stance, self.motion.stance(time_s - elapsed), elapsed)
        transforms = torch.from_numpy(world_from_bind).float()
        bound = self.bound
        vertices, normals = skin_with_normals(
            bound.mesh.vertices, bound.normals, bound.joints, bound.weights, transforms
        )
        faces = bound.mesh.faces
        texture = torch.zeros(len(faces), dtype=torch.int64)
        return TexturedMesh(Mesh(vertices, faces), normals, bound.uv, texture, (bound.atlas,))


def procedural_performer(seed: int, *, style: PerformerStyle | None = None) -> ProceduralPerformer:
    """A clothed person in motion, the same for the same seed (and style), bit for bit."""
    style = style or PerformerStyle()
    body_rng, cloth_rng, hair_rng, motion_rng = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)
    )
    person = sample_physique(body_rng)
    outfit = sample_outfit(cloth_rng, person.femininity)
    hair = sample_hair(hair_rng, person.femininity, person.skin_rgb[0] < 0.6)
    skeleton = build_skeleton(person)
    body = build_body(person, skeleton)
    head = build_head(person, skeleton)
    wearer = Wearer(body, skeleton, person.height_m)
    tailor = Tailor(wearer, outfit, sample_cut(outfit))
    patches = tailor.top() + tailor.bottom() + tailor.outer()
    patches += head_patches(person, head, hair_rng, hair.color)
    patches += hair_patches(head, hair, body.torso, outfit.fabrics[1].colors[0])
    patches += _skin_patches(person, wearer, tailor.cut, hair_rng)
    shoes = tailor.shoes_rgb()
    patches += [shoe_patch(skeleton, person.height_m, side, shoes[0], shoes[1]) for side in SIDES]
    tempos: tuple[Tempo, ...] = ("calm", "dance", "fast")
    tempo = style.tempo or tempos[int(motion_rng.integers(3))]
    bulk = 0.06 + 0.08 * max(person.weight, 0) + (0.10 if outfit.outer != "none" else 0.0)
    motion = sample_motion(motion_rng, person, skeleton, tempo, style.motion, bulk)
    sex = "woman" if person.femininity > 0.5 else "man"
    words = f"{sex}, {person.height_m:.2f} m, {hair.style} hair, {outfit.words}, {motion.score.kind} ({tempo})"
    return ProceduralPerformer(assemble(patches), skeleton, motion, words)


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
    arm, leg = max(cut.sleeve - 0.15, -0.03), max(cut.leg - 0.12, 0.0)
    for i in (0, 1):
        patches.append(
            limb_sheet(wearer, wearer.body, 1 + i, arm, 1.0, paint, rows=8 + int(24 * (1 - arm)), columns=21)
        )
        patches.append(
            limb_sheet(wearer, wearer.body, 3 + i, leg, 1.04, paint, rows=8 + int(28 * (1 - leg)), columns=25)
        )
    skin = paint(Canvas(0.1, 0.1))
    girth = 1.05 - 0.13 * person.femininity + 0.05 * person.weight
    for side in SIDES:
        patches += hand_patches(wearer.body, wearer.skeleton, H, side, skin, girth)
    return patches


def procedural_scene(seed: int, *, style: PerformerStyle | None = None) -> Performer:
    """One or two performers with props."""
    return procedural_performer(seed, style=style)
