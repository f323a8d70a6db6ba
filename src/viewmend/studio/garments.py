"""Segmentation of a character's texture into garments with body positions, and replacement of their cloth."""

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.studio.gltf import Character
from viewmend.studio.procedural.fabric import QUIET, WORDS, Canvas, Image, Plane, sample_fabric, write
from viewmend.studio.retarget import find_parts, node_matrices

LIMBS = {
    # Name: upper and lower end, and the parts whose joints move it. The trunk stands on the middle
    # of the feet.
    "trunk": ("Hips", "", ("Hips", "Spine", "Spine1", "Spine2", "Neck", "LeftShoulder", "RightShoulder")),
    "left arm": ("LeftArm", "LeftForeArm", ("LeftArm", "LeftForeArm")),
    "right arm": ("RightArm", "RightForeArm", ("RightArm", "RightForeArm")),
    "left leg": ("LeftUpLeg", "LeftFoot", ("LeftUpLeg", "LeftLeg")),
    "right leg": ("RightUpLeg", "RightFoot", ("RightUpLeg", "RightLeg")),
    "feet": ("Hips", "", ("LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase")),
    "hands": ("", "", ("LeftHand", "RightHand")),
    "head": ("", "", ("Head",)),
}
"""Each limb's upper and lower joint, and the parts whose joints move it. Hands and head are
never clothed."""
Limbs = Int[np.ndarray, "height width"]
"""Indices into `NAMES`; -1 for none."""
NAMES = tuple(LIMBS)
TRUNK, LEGS, FEET, HANDS, HEAD = (
    NAMES.index(name) for name in ("trunk", "left leg", "feet", "hands", "head")
)

SHOULDER_M = 0.75
"""Height on the chart of a cloth at which sleeves begin, metres; it keeps them below patterns
across the chest."""
SKIN_RAD = (0.42, 0.25)
"""Skin may be this much redder and yellower than the hues of hands and face: radians in the a-b
plane of CIELAB."""
SKIN_CHROMA = (0.5, 1.7)
"""Skin has a chroma within these multiples of theirs: bare legs are darker, greyer and
redder than hands."""
LIGHTNESS = 0.5
"""Weight of lightness relative to the two hues when garments are separated; folds change lightness."""
MAX_GARMENTS = 4
MIN_DISTANCE_LAB = 18.0
"""Colours that are closer than this in CIELAB belong to one garment."""
MIN_FRACTION = 0.02
"""A garment that covers less than this fraction of the cloth is merged with the one next in
colour."""
FACE_M = 0.06
"""The face lies in front of the head's joint by at least this distance, metres."""
MARGIN_PX = 4
"""Cloth continues by this many pixels, at half size, over texels that no face shows."""
BODY_SHARE = 0.25
"""Fraction of a texture outside of head and hands below which it has no clothes, but hair, hats,
glasses or gloves."""
CHART = Canvas(1.4, 1.65, 250.0)
"""Canvas of a flat cloth: around the trunk with 0 in front, and from the soles to the collar."""
CHEST_M = 1.22
"""Height of lettering above the soles, metres."""
FOLDS = 0.12
"""Lightness that is added to both sides of the ratio that keeps folds: black cloth would be all
noise."""
_DYED_FRACTION = 0.3
"""Fraction of garments that are dyed instead of replaced; shoes always are."""
_ONE_PIECE_FRACTION = 0.4
"""Fraction of overalls that stay in one piece; the others become a top and trousers."""
_LETTERED_FRACTION = 0.4
"""Fraction of quietly patterned tops with text across the chest."""
_GRAY = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in luma (BT.601)."""


@dataclass(frozen=True)
class Garments:
    """The cloth of one texture, at half its width and height."""

    cover: Float[np.ndarray, "garment height width"]
    """Coverage of each garment: 1 on its texels and on hidden ones next to them, so that mipmaps do
    not mix in other colours; 0 on hands and head."""
    shown: Bool[np.ndarray, "height width"]
    """Texels that a face shows."""
    bare: Bool[np.ndarray, "height width"]
    """Texels of hands and head."""
    around_m: Plane
    """Distance around the limb, metres: 0 in front, growing towards the body's left (for arms, to
    some fixed side)."""
    along_m: Plane
    """Height above the soles, metres; on arms, `SHOULDER_M` at the shoulder, falling
    towards the hand."""
    color_label: tuple[int, ...]
    """Number of the colour that each garment was found by; both halves of an overall have
    the same."""
    shoes: tuple[bool, ...]
    """Whether each garment is on the feet."""


@dataclass(frozen=True)
class RestBody:
    """A character in its upright rest pose: metres, y up, facing +z."""

    vertices: Float[Tensor, "vertex 3"]
    joints: dict[str, Float[np.ndarray, "3"]]
    """Position of each part's joint, metres."""
    limb_of_face: Int[Tensor, "face"]
    """Index into `NAMES`."""


def rest_body(character: Character, upright_from_file: Float[Tensor, "4 4"]) -> RestBody:
    """Put a character into its upright rest pose, and assign each face to the limb whose joints move it most.

    Raises:
        ValueError: the skeleton is not human.
    """
    part_of = {name: part for part, name in find_parts([n.name for n in character.nodes]).items()}
    world = node_matrices(character, upright_from_file)
    owner = {part: n for n, limb in enumerate(NAMES) for part in LIMBS[limb][2]}
    limb_of_node: list[int] = []
    for node in character.nodes:
        above = limb_of_node[node.parent] if node.parent >= 0 else 0
        limb_of_node.append(owner[part_of[node.name]] if node.name in part_of else above)
    limb = torch.tensor(limb_of_node)[character.node_of_joint][character.joints]
    share = torch.zeros(len(limb), len(NAMES)).scatter_add_(1, limb, character.weights)
    matrices = world[character.node_of_joint] @ character.joint_from_bind
    vertices = character.skin(matrices).mesh.vertices
    joints = {
        part_of[n.name]: world[i, :3, 3].numpy() for i, n in enumerate(character.nodes) if n.name in part_of
    }
    return RestBody(vertices, joints, share[character.rest.mesh.faces].sum(1).argmax(1))


def find_garments(character: Character, body: RestBody) -> list[Garments | None]:
    """Find the garments on each texture; None for textures without any (hair, eyes, bare skin)."""
    lab = []
    maps = []
    for n, texture in enumerate(character.rest.textures):
        width = max(1, texture.shape[2] // 2)
        height = max(1, texture.shape[1] // 2)
        half = cv2.resize(cv2.merge(list(texture.numpy())), (width, height), interpolation=cv2.INTER_AREA)
        lab.append(cv2.cvtColor(half, cv2.COLOR_RGB2LAB))
        maps.append(_texels(character, body, n, width, height))
    bare = _skin_hues(lab, maps, body)
    return [_garments(image, bare, limb, place, body) for image, (limb, place) in zip(lab, maps, strict=True)]


def _texels(
    character: Character, body: RestBody, texture: int, width: int, height: int
) -> tuple[Limbs, Image]:
    """Compute the limb of each texel, -1 where no face shows it, and its position in the rest pose."""
    rest = character.rest
    of_texture = (rest.texture_of_face == texture).nonzero()[:, 0]
    flat = Mesh(torch.cat([rest.uv, torch.ones(len(rest.uv), 1)], 1), rest.mesh.faces[of_texture])
    # A camera facing the plane z = 1 of texture coordinates has one texel per pixel.
    K = torch.diag(torch.tensor([float(width), float(height), 1.0]))
    camera = Cameras(("texture",), K[None], torch.eye(4)[None], torch.tensor([[width, height]]))
    raster = rasterize(flat, camera)
    limb = torch.cat([body.limb_of_face[of_texture], torch.tensor([-1])])[raster.triangle[0].long()]
    return limb.numpy(), interpolate(body.vertices, flat, camera, raster)[0].numpy()


def _skin_hues(
    lab: list[np.ndarray], maps: list[tuple[np.ndarray, np.ndarray]], body: RestBody
) -> Float[np.ndarray, "2 2"] | None:
    """Find the hues (a and b) of hands and face; None if neither shows. Hair and gloves do not count."""
    face = body.joints["Head"][2] + FACE_M if "Head" in body.joints else -np.inf
    hands = []
    faces = []
    for image, (limb, place) in zip(lab, maps, strict=True):
        hands.append(image[limb == HANDS][::7, 1:])
        # Wigs hang in front of the head, too: a face is on the texture that has the hands.
        faces.append(image[(limb == HEAD) & (place[..., 2] > face) & (limb == HANDS).any()][::7, 1:])
    medians = [np.median(values, 0) for values in map(np.concatenate, (hands, faces)) if len(values)]
    return np.stack((medians[0], medians[-1])) if medians else None


def _is_skin(lab: Image, hues: Float[np.ndarray, "2 2"]) -> Bool[np.ndarray, "height width"]:
    """Find texels whose hue and chroma are those of hands and face (see `SKIN_RAD`)."""
    angle = np.arctan2(hues[:, 1], hues[:, 0])
    chroma = np.linalg.norm(hues, axis=1)
    red = angle.min() - SKIN_RAD[0]
    yellow = angle.max() + SKIN_RAD[1]
    # Without an arc tangent for each texel: on the right side of both lines through grey.
    a = lab[..., 1]
    b = lab[..., 2]
    between = (b * np.cos(red) > a * np.sin(red)) & (b * np.cos(yellow) < a * np.sin(yellow))
    square = a * a + b * b
    low, high = np.multiply(SKIN_CHROMA, (chroma.min(), chroma.max()))
    return between & (square > low**2) & (square < high**2)


def _centers(values: Float[np.ndarray, "sample 3"]) -> Float[np.ndarray, "color 3"]:
    """Cluster colours: the farthest is added until none is far from all; then two rounds of k-means."""
    centers = np.median(values, 0)[None]
    while len(centers) < MAX_GARMENTS:
        distance = np.sqrt(((values[:, None] - centers) ** 2).sum(-1).min(1))
        # Not the very farthest, which may be a speck.
        far = int(np.argsort(distance)[int(0.97 * (len(values) - 1))])
        if distance[far] < MIN_DISTANCE_LAB:
            break
        centers = np.concatenate([centers, values[far][None]])
    for _ in range(2):
        label = _nearest(values, centers)
        centers = np.stack(
            [values[label == n].mean(0) if (label == n).any() else c for n, c in enumerate(centers)]
        )
    return centers


def _nearest(
    values: Float[np.ndarray, "*any 3"], centers: Float[np.ndarray, "color 3"]
) -> Int[np.ndarray, "*any"]:
    """Index of the centre nearest to each value."""
    return (0.5 * (centers**2).sum(1) - values @ centers.T).argmin(-1)


def _garments(
    lab: Image, hues: Float[np.ndarray, "2 2"] | None, limb: Limbs, place: Image, body: RestBody
) -> Garments | None:
    shown = limb >= 0
    bare = limb >= HANDS
    clothable = (shown & ~bare).astype(np.float32)
    if clothable.sum() < BODY_SHARE * shown.sum():
        return None
    naked = np.zeros_like(clothable) if hues is None else clothable * _is_skin(lab, hues)
    cloth = clothable * (_smooth(naked, 9) < 0.5 * _smooth(clothable, 9))
    inside = cloth > 0
    if inside.sum() < MIN_FRACTION * cloth.size:
        return None
    weight = np.maximum(_smooth(cloth, 3), 1e-3)
    color = _smooth(lab * cloth[..., None] * np.array([LIGHTNESS, 1, 1], np.float32), 3) / weight[..., None]
    label = _nearest(color, _centers(color[inside][::23]))
    around, along = _unroll_limbs(limb, place, body)
    below = (limb >= LEGS) | (limb == TRUNK) & (
        along < float(body.joints["Hips"][1] - body.vertices[:, 1].min())
    )
    covers = []
    color_label = []
    shoes = []
    for n, where in itertools.product(range(label.max() + 1), (~below, below & (limb < FEET), limb == FEET)):
        part = inside & (label == n) & where
        if part.sum() > MIN_FRACTION * inside.sum():
            margin = (_smooth(part, 2 * MARGIN_PX + 1) > 0) & ~shown
            covers.append((part | margin).astype(np.float32))
            color_label.append(n)
            shoes.append(bool((limb[part] == FEET).any()))
    return (
        Garments(np.stack(covers), shown, bare, around, along, tuple(color_label), tuple(shoes))
        if covers
        else None
    )


def _smooth(values: np.ndarray, size: int) -> np.ndarray:
    return cv2.blur(values.astype(np.float32), (size, size))


def _unroll_limbs(limb: Limbs, place: Image, body: RestBody) -> tuple[Plane, Plane]:
    """Compute coordinates around and along each limb, as if it were a cylinder."""
    around = np.zeros(limb.shape, np.float32)
    along = np.zeros(limb.shape, np.float32)
    floor = float(body.vertices[:, 1].min())
    for n, name in enumerate(NAMES[:HANDS]):
        at = limb == n
        if not at.any():
            continue
        upper, lower = (body.joints.get(part) for part in LIMBS[name][:2])
        top = body.joints["Hips"] if upper is None else upper
        bottom = (
            top * np.array([1, 0, 1], np.float32) + np.array([0, floor, 0], np.float32)
            if lower is None
            else lower
        )
        axis = (top - bottom) / np.linalg.norm(top - bottom)
        front = np.array([0.0, 0.0, 1.0]) - axis[2] * axis
        front /= np.linalg.norm(front)
        frame = np.stack([np.cross(axis, front), axis, front]).astype(np.float32)
        x, y, z = ((place[at] - top) @ frame.T).T.copy()
        around[at] = np.median(np.hypot(x, z)) * np.arctan2(x, z)
        along[at] = y + np.float32(SHOULDER_M if "arm" in name else top[1] - floor)
    return around, along


def vary_cloth(
    character: Character, upright_from_file: Float[Tensor, "4 4"], variety: float, seed: int
) -> Character:
    """Change a character's clothes; skin, hair and eyes are unchanged.

    Each garment is found by its colour, and with a chance of `variety` either dyed (its own pattern
    in other hues) or replaced by a seeded cloth: plain, striped, checked, printed or lettered,
    under the garment's folds.

    Raises:
        ValueError: `variety` is not in [0, 1], or the skeleton is not human.
    """
    if not 0 <= variety <= 1:
        raise ValueError(
            f"expected a variety of cloth from 0 to 1, got {variety}; it is the share that changes"
        )
    if variety == 0:
        return character
    rng = np.random.default_rng([seed, 31])
    found = find_garments(character, rest_body(character, upright_from_file))
    textures = []
    for texture, garments in zip(character.rest.textures, found, strict=True):
        if garments is None:
            textures.append(texture)
            continue
        image = cv2.merge(list(texture.numpy()))
        seeds: dict[int, int] = {}
        for n, (label, is_shoe) in enumerate(zip(garments.color_label, garments.shoes, strict=True)):
            changes = rng.random() < variety
            seed = int(rng.integers(2**31))
            # The halves of an overall: the second takes the seed of the first.
            seed = (
                seeds[label]
                if not is_shoe and label in seeds and rng.random() < _ONE_PIECE_FRACTION
                else seed
            )
            seeds[label] = seed
            if changes:
                _change_garment(image, garments, n, np.random.default_rng(seed))
        textures.append(torch.from_numpy(np.stack(cv2.split(image))))
    return replace(character, rest=replace(character.rest, textures=tuple(textures)))


def _change_garment(image: Image, garments: Garments, n: int, rng: np.random.Generator) -> None:
    """Change one garment of a texture, in place."""
    rows, columns = (np.flatnonzero(garments.cover[n].any(axis)) for axis in (1, 0))
    half = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    # Half a texture's odd last row or column stays as it is.
    full = tuple(slice(2 * s.start, 2 * s.stop) for s in half)
    own = image[full]
    size = tuple(2 * (s.stop - s.start) for s in reversed(half))

    def at_full_size(values: np.ndarray) -> np.ndarray:
        return cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)

    # Bilinear edges are soft, and would reach half a texel into hands and neck.
    bare = cv2.resize(garments.bare[half].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    cover = np.where(bare, 0, at_full_size(garments.cover[n][half]))[..., None]
    if garments.shoes[n] or rng.random() < _DYED_FRACTION:
        new = _dye(own, rng)
    else:
        color = at_full_size(_colors(garments, n, half, rng))
        new = np.clip(
            color * _folds(own, cover[..., 0], at_full_size(garments.shown[half].astype(np.float32))), 0, 1
        )
    own += cover * (new - own)


def _dye(own: Image, rng: np.random.Generator) -> Image:
    """Rotate hues, change saturation and brightness, and tint, so that grey takes on a colour too."""
    turn = rng.uniform(0, 2 * np.pi)
    strength = rng.uniform(0.4, 1.2)
    gain = np.exp(rng.uniform(-0.35, 0.45))
    axis = np.full(3, 3**-0.5)
    across = np.cross(np.eye(3), axis)
    rotation = np.cos(turn) * np.eye(3) + np.sin(turn) * across + (1 - np.cos(turn)) * np.outer(axis, axis)
    gray = np.tile(_GRAY.astype(np.float64), (3, 1))
    tint = np.exp(rng.normal(0, 0.2, 3))
    matrix = gain * np.diag(tint / (_GRAY @ tint)) @ (gray + strength * rotation @ (np.eye(3) - gray))
    return np.clip(cv2.transform(own, matrix.astype(np.float32)), 0, 1)


def _colors(garments: Garments, n: int, window: tuple[slice, slice], rng: np.random.Generator) -> Image:
    """Paint another cloth on the garment's window, without folds; hidden texels have its mean colour."""
    fabric = sample_fabric(rng)
    cloth = fabric.paint(CHART)
    # Perhaps with a word across the chest.
    if fabric.kind in QUIET and rng.random() < _LETTERED_FRACTION:
        word = WORDS[int(rng.integers(len(WORDS)))]
        cloth = write(cloth, CHART, word, fabric.colors[2], (0.0, CHEST_M), rng.uniform(0.2, 0.3))
    chart = (255 * cloth).astype(np.uint8)
    column = (garments.around_m[window] + CHART.width_m / 2) * CHART.px_per_m - 0.5
    row = (CHART.height_m - garments.along_m[window]) * CHART.px_per_m - 0.5
    color = (
        cv2.remap(chart, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT).astype(np.float32)
        / 255
    )
    shown = garments.shown[window]
    part = garments.cover[n][window] > 0
    known = (shown & part).astype(np.float32)
    # Wide enough for the margin of any cover (`MARGIN_PX`).
    mean = (
        cv2.blur(color * known[..., None], (13, 13)) / np.maximum(cv2.blur(known, (13, 13)), 1e-4)[..., None]
    )
    return np.where((known > 0)[..., None], color, mean)


def _folds(own: Image, cover: Plane, shown: Plane) -> Float[np.ndarray, "height width 1"]:
    """Estimate the shading of a garment, around 1; 1 on hidden texels."""
    gray = cv2.transform(own, _GRAY[None])
    weight = cover * shown
    mean = float((gray * weight).sum() / max(float(weight.sum()), 1e-6))
    shade = np.clip((gray + FOLDS) / (mean + FOLDS), 0.45, 1.6)
    return (1 + shown * (shade - 1))[..., None]
