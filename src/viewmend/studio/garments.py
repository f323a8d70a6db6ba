"""Which texels of a character's texture are cloth, of which garment, and where on the body they lie."""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.studio.gltf import Character
from viewmend.studio.retarget import node_matrices
from viewmend.studio.skeletons import find_parts
from viewmend.studio.skinning import skin

LIMBS = {
    # Name: upper and lower end, and the parts whose joints move it. The trunk stands on the middle of the feet.
    "trunk": ("Hips", "", ("Hips", "Spine", "Spine1", "Spine2", "Neck", "LeftShoulder", "RightShoulder")),
    "left arm": ("LeftArm", "LeftForeArm", ("LeftArm", "LeftForeArm")),
    "right arm": ("RightArm", "RightForeArm", ("RightArm", "RightForeArm")),
    "left leg": ("LeftUpLeg", "LeftFoot", ("LeftUpLeg", "LeftLeg")),
    "right leg": ("RightUpLeg", "RightFoot", ("RightUpLeg", "RightLeg")),
    "feet": ("Hips", "", ("LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase")),
    "hands": ("", "", ("LeftHand", "RightHand")),
    "head": ("", "", ("Head",)),
}
"""Hands and head are never clothed: skin and hair are theirs."""
NAMES = tuple(LIMBS)
TRUNK, LEGS, FEET, HANDS, HEAD = (NAMES.index(name) for name in ("trunk", "left leg", "feet", "hands", "head"))

SHOULDER_M = 0.75
"""Where sleeves begin on the chart of a cloth: what is across the chest is not on them."""
SKIN_RAD = (0.42, 0.25)
"""Skin has a hue (direction of a, b in CIELAB) of hands or face, at most this much redder or yellower."""
SKIN_CHROMA = (0.5, 1.7)
"""Skin also has a chroma within these multiples of theirs: bare legs are darker, greyer and redder than hands."""
LIGHTNESS = 0.5
"""Weight of lightness beside the two hues where garments are told apart: cloth has folds."""
MOST_GARMENTS = 4
APART_LAB = 18.0
"""Cloth of colours nearer than this is one garment."""
LEAST_SHARE = 0.02
"""Fraction of the cloth below which a garment is part of the one next in colour."""
FACE_M = 0.06
"""The face is what is this far in front of the head's joint."""
MARGIN_PX = 4
"""How far cloth continues, at half size, over texels that no face shows."""
BODY_SHARE = 0.25
"""Textures of which less than this lies neither on the head nor on the hands are hair, hats, glasses, gloves."""


@dataclass(frozen=True)
class Garments:
    """The cloth of one texture, at half its width and height."""

    cover: Float[np.ndarray, "garment height width"]
    """1 where a garment is, and next to it where no face shows the texture (smaller levels of it do); 0 on hands and
    head."""
    shown: Bool[np.ndarray, "height width"]
    """Texels that a face shows."""
    bare: Bool[np.ndarray, "height width"]
    """Texels of hands and head."""
    around_m: Float[np.ndarray, "height width"]
    """Way around the limb, 0 in front, growing towards the body's left (for arms: some fixed side)."""
    along_m: Float[np.ndarray, "height width"]
    """Height above the soles; on arms `SHOULDER_M` at the shoulder, falling towards the hand."""
    dress: tuple[int, ...]
    """For each garment the number of the colour that it was found by: the halves of an overall share it."""
    shoes: tuple[bool, ...]
    """Garments that are on the feet."""


@dataclass(frozen=True)
class RestBody:
    """A character upright at rest: metres, y up, facing +z."""

    vertices: Float[Tensor, "vertex 3"]
    joints: dict[str, Float[np.ndarray, "3"]]
    """Where each part's joint is."""
    limb_of_face: Int[Tensor, "face"]
    """Position in `NAMES`."""


def rest_body(character: Character, upright_from_file: Float[Tensor, "4 4"]) -> RestBody:
    """Stand a character in its rest pose, and assign each face to the limb whose joints move it most.

    Raises:
        ValueError: its skeleton is no human one.
    """
    names, parents = [n.name for n in character.nodes], [n.parent for n in character.nodes]
    part_of = {name: part for part, name in find_parts(names, parents).items()}
    world = node_matrices(character, upright_from_file, (-1,) * len(names), torch.zeros(0, 3, 3), None)
    owner = {part: n for n, limb in enumerate(NAMES) for part in LIMBS[limb][2]}
    limb_of_node: list[int] = []
    for name, parent in zip(names, parents, strict=True):
        above = limb_of_node[parent] if parent >= 0 else 0
        limb_of_node.append(owner[part_of[name]] if name in part_of else above)
    limb = torch.tensor(limb_of_node)[character.node_of_joint][character.joints]
    share = torch.zeros(len(limb), len(NAMES)).scatter_add_(1, limb, character.weights)
    matrices = world[character.node_of_joint] @ character.joint_from_bind
    vertices = skin(character.vertices, character.joints, character.weights, matrices)
    joints = {part_of[name]: world[n, :3, 3].numpy() for n, name in enumerate(names) if name in part_of}
    return RestBody(vertices, joints, share[character.faces].sum(1).argmax(1))


def find_garments(character: Character, body: RestBody) -> list[Garments | None]:
    """The cloth of each texture, None where there is none (hair, eyes, bare skin)."""
    lab = [_half_lab(texture) for texture in character.textures]
    maps = [_texels(character, body, n, image.shape[:2]) for n, image in enumerate(lab)]
    bare = _skin_hues(lab, maps, body)
    return [_garments(image, bare, *at, body) for image, at in zip(lab, maps, strict=True)]


def _half_lab(texture: Float[Tensor, "3 _ _"]) -> Float[np.ndarray, "height width 3"]:
    """The texture at half its size in CIELAB."""
    height, width = texture.shape[1:]
    image = cv2.merge(list(texture.numpy()))
    half = cv2.resize(image, (max(1, width // 2), max(1, height // 2)), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(half, cv2.COLOR_RGB2LAB)


def _texels(
    character: Character, body: RestBody, texture: int, size: tuple[int, ...]
) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width 3"]]:
    """Limb of each texel, -1 where no face shows it, and its place at rest."""
    height, width = size
    of_texture = (character.texture_of_face == texture).nonzero()[:, 0]
    flat = Mesh(torch.cat([character.uv, torch.ones(len(character.uv), 1)], 1), character.faces[of_texture])
    # A camera that looks at the plane z = 1 of texture coordinates sees a texel in each pixel.
    K = torch.diag(torch.tensor([float(width), float(height), 1.0]))
    camera = Cameras(("texture",), K[None], torch.eye(4)[None], torch.tensor([[width, height]]))
    raster = rasterize(flat, camera)
    limb = torch.cat([body.limb_of_face[of_texture], torch.tensor([-1])])[raster.triangle[0].long()]
    return limb.numpy(), interpolate(body.vertices, flat, camera, raster)[0].numpy()


def _skin_hues(
    lab: list[np.ndarray], maps: list[tuple[np.ndarray, np.ndarray]], body: RestBody
) -> Float[np.ndarray, "2 2"] | None:
    """Hues (a and b) of the hands and of the face, None where neither shows; hair and gloves do not count."""
    medians = []
    for which in (HANDS, HEAD):
        found = []
        for image, (limb, place) in zip(lab, maps, strict=True):
            at = limb == which
            if which == HEAD and "Head" in body.joints:
                at &= place[..., 2] > body.joints["Head"][2] + FACE_M
            # Wigs hang in front of the head, too: a face is on the texture that has the hands.
            found.append(image[at & (limb == HANDS).any()][::7, 1:])
        values = np.concatenate(found)
        medians += [np.median(values, 0)] if len(values) else []
    return np.stack((medians[0], medians[-1])) if medians else None


def _is_skin(
    lab: Float[np.ndarray, "height width 3"], hues: Float[np.ndarray, "2 2"]
) -> Bool[np.ndarray, "height width"]:
    """Texels that look like hands and face (see `SKIN_RAD`)."""
    angle, chroma = np.arctan2(hues[:, 1], hues[:, 0]), np.linalg.norm(hues, axis=1)
    red, yellow = angle.min() - SKIN_RAD[0], angle.max() + SKIN_RAD[1]
    # Without an arc tangent for each texel: on the right side of both lines through grey.
    a, b = lab[..., 1], lab[..., 2]
    between = (b * np.cos(red) > a * np.sin(red)) & (b * np.cos(yellow) < a * np.sin(yellow))
    square, (low, high) = a * a + b * b, np.multiply(SKIN_CHROMA, (chroma.min(), chroma.max()))
    return between & (square > low**2) & (square < high**2)


def _centers(values: Float[np.ndarray, "sample 3"], most: int, apart: float) -> Float[np.ndarray, "color 3"]:
    """Colours that stand for many: farthest first until none is `apart` from all, then two rounds of means."""
    centers = np.median(values, 0)[None]
    while len(centers) < most:
        distance = np.sqrt(((values[:, None] - centers) ** 2).sum(-1).min(1))
        # Not the very farthest, which may be a speck.
        far = int(np.argsort(distance)[int(0.97 * (len(values) - 1))])
        if distance[far] < apart:
            break
        centers = np.concatenate([centers, values[far][None]])
    for _ in range(2):
        label = _nearest(values, centers)
        centers = np.stack([values[label == n].mean(0) if (label == n).any() else c for n, c in enumerate(centers)])
    return centers


def _nearest(values: Float[np.ndarray, "*any 3"], centers: Float[np.ndarray, "color 3"]) -> Int[np.ndarray, "*any"]:
    """Which centre is nearest to each value."""
    return (0.5 * (centers**2).sum(1) - values @ centers.T).argmin(-1)


def _garments(
    lab: Float[np.ndarray, "height width 3"],
    skin: Float[np.ndarray, "2 2"] | None,
    limb: Int[np.ndarray, "height width"],
    place: Float[np.ndarray, "height width 3"],
    body: RestBody,
) -> Garments | None:
    shown, bare = limb >= 0, limb >= HANDS
    clothable = (shown & ~bare).astype(np.float32)
    if clothable.sum() < BODY_SHARE * shown.sum():
        return None
    naked = np.zeros_like(clothable) if skin is None else clothable * _is_skin(lab, skin)
    cloth = clothable * (_smooth(naked, 9) < 0.5 * _smooth(clothable, 9))
    inside = cloth > 0
    if inside.sum() < LEAST_SHARE * cloth.size:
        return None
    weight = np.maximum(_smooth(cloth, 3), 1e-3)
    color = _smooth(lab * cloth[..., None] * np.array([LIGHTNESS, 1, 1], np.float32), 3) / weight[..., None]
    label = _nearest(color, _centers(color[inside][::23], MOST_GARMENTS, APART_LAB))
    around, along = _unrolled(limb, place, body)
    below = (limb >= LEGS) | (limb == TRUNK) & (along < float(body.joints["Hips"][1] - body.vertices[:, 1].min()))
    covers, dress, shoes = [], [], []
    for n, where in itertools.product(range(label.max() + 1), (~below, below & (limb < FEET), limb == FEET)):
        part = inside & (label == n) & where
        if part.sum() > LEAST_SHARE * inside.sum():
            beside = (_smooth(part, 2 * MARGIN_PX + 1) > 0) & ~shown
            covers.append((part | beside).astype(np.float32))
            dress.append(n)
            shoes.append(bool((limb[part] == FEET).any()))
    return Garments(np.stack(covers), shown, bare, around, along, tuple(dress), tuple(shoes)) if covers else None


def _smooth(values: np.ndarray, size: int) -> np.ndarray:
    return cv2.blur(values.astype(np.float32), (size, size))


def _unrolled(
    limb: Int[np.ndarray, "height width"], place: Float[np.ndarray, "height width 3"], body: RestBody
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Coordinates around and along each limb, as if it were a cylinder."""
    around, along = np.zeros(limb.shape, np.float32), np.zeros(limb.shape, np.float32)
    floor = float(body.vertices[:, 1].min())
    for n, name in enumerate(NAMES[:HANDS]):
        at = limb == n
        if not at.any():
            continue
        upper, lower = (body.joints.get(part) for part in LIMBS[name][:2])
        top = body.joints["Hips"] if upper is None else upper
        bottom = top * np.array([1, 0, 1], np.float32) + np.array([0, floor, 0], np.float32) if lower is None else lower
        axis = (top - bottom) / np.linalg.norm(top - bottom)
        front = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
        front /= np.linalg.norm(front)
        frame = np.stack([np.cross(axis, front), axis, front]).astype(np.float32)
        x, y, z = ((place[at] - top) @ frame.T).T.copy()
        around[at] = np.median(np.hypot(x, z)) * np.arctan2(x, z)
        along[at] = y + np.float32(SHOULDER_M if "arm" in name else top[1] - floor)
    return around, along
