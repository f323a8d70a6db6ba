"""What is worn: outfits drawn from a seed, cut from the body's own shape and painted with cloth."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from viewmend.capture.studio.procedural.body import Body
from viewmend.capture.studio.procedural.fabric import (
    WORDS,
    Canvas,
    Fabric,
    Image,
    blend,
    edge,
    hsv,
    sample_fabric,
    write,
)
from viewmend.capture.studio.procedural.patches import Patch
from viewmend.capture.studio.procedural.sheets import (
    Azimuths,
    Folds,
    Wearer,
    azimuths,
    limb_sheet,
    skirt_sheets,
    torso_sheet,
)

TOPS = ("t-shirt", "long sleeves", "shirt", "sweater", "tank top")
OUTERS = ("none", "jacket", "coat")
BOTTOMS = ("trousers", "jeans", "wide trousers", "leggings", "shorts", "skirt", "dress")
LOOSE = ("plain", "heather", "denim", "tartan", "gingham", "knit", "pinstripes")
LOWER = ("plain", "heather", "pinstripes", "tartan", "blobs", "knit", "zigzag", "gingham")


@dataclass(frozen=True)
class Outfit:
    """A top, what covers the legs, perhaps something over both, and shoes."""

    top: str
    bottom: str
    outer: str
    fabrics: tuple[Fabric, Fabric, Fabric]
    """Of top, bottom and outer."""
    lettering: str
    """Across the chest; empty for none."""
    shoes: Float[np.ndarray, "2 3"]
    """Upper and sole, sRGB."""
    seed: int

    @property
    def words(self) -> str:
        """For a description."""
        lower = "" if self.bottom == "dress" else f" and {self.fabrics[1].kind} {self.bottom}"
        upper = "dress" if self.bottom == "dress" else self.top
        outer = "" if self.outer == "none" else f" under a {self.outer}"
        return f"{self.fabrics[0].kind} {upper}{lower}{outer}"


def sample_outfit(rng: np.random.Generator, femininity: float) -> Outfit:
    """Draw an outfit."""
    odds = [0.26, 0.22, 0.12, 0.08, 0.12, 0.11, 0.09] if femininity > 0.5 else [0.32, 0.34, 0.1, 0.02, 0.22, 0, 0]
    bottom = BOTTOMS[int(rng.choice(len(BOTTOMS), p=np.array(odds) / sum(odds)))]
    top = TOPS[int(rng.choice(len(TOPS), p=[0.32, 0.2, 0.2, 0.2, 0.08]))]
    outer = OUTERS[int(rng.choice(3, p=[0.72, 0.16, 0.12]))]
    lower = sample_fabric(rng, ("denim",) if bottom == "jeans" else LOWER)
    fabrics = (sample_fabric(rng), lower, sample_fabric(rng, LOOSE))
    written = bottom != "dress" and outer == "none" and rng.random() < 0.4
    lettering = WORDS[int(rng.integers(len(WORDS)))] if written else ""
    light = rng.random() < 0.5
    upper = hsv(rng.random(), rng.uniform(0, 0.7) * (rng.random() < 0.5), rng.uniform(0.1, 0.95))
    sole = np.full(3, 0.9) if light else np.full(3, 0.12)
    return Outfit(top, bottom, outer, fabrics, lettering, np.stack([upper, sole]), int(rng.integers(2**31)))


def neckline(around: Azimuths, height_m: float, depth: float, vee: bool = False, wide: float = 0.0) -> Azimuths:
    """Heights of a neckline in metres: `depth` (share of the height) lower in front, round or V-shaped."""
    turn = np.abs(np.angle(np.exp(1j * around)))
    dip = np.clip(1 - turn / 0.75, 0, 1) if vee else np.exp(-((turn / 0.85) ** 2))
    return (0.836 - wide - depth * dip) * height_m


@dataclass(frozen=True)
class Tailor:
    """Cuts garments for one wearer."""

    wearer: Wearer
    outfit: Outfit

    def folds(self, depth_m: float, along_m: float, around_m: float, number: int) -> Folds:
        """Creases with a seed of their own."""
        return Folds(depth_m, along_m, around_m, self.outfit.seed % 100_000 + 17 * number)

    def top(self) -> list[Patch]:
        """Shirt, sweater or the like: trunk and sleeves."""
        H, outfit, body = self.wearer.height_m, self.outfit, self.wearer.body
        rng = np.random.default_rng(outfit.seed)
        loose = {"sweater": 0.016, "shirt": 0.012, "t-shirt": 0.010}.get(outfit.top, 0.006) + 0.006 * rng.random()
        hang = float(rng.uniform(0.35, 0.95)) if outfit.top != "tank top" else 0.2
        torso = body.torso.eased(loose, hang, 0.004)
        sleeve = {"t-shirt": rng.uniform(0.2, 0.42), "tank top": 0.0}.get(outfit.top, rng.uniform(0.93, 1.0))
        if outfit.outer == "none" and outfit.top == "shirt" and rng.random() < 0.3:
            sleeve = rng.uniform(0.5, 0.6)
        wide = loose + 0.004
        arms = [arm.eased(wide, 0.10 if sleeve < 0.5 else 0.55, 0.012 if sleeve < 0.5 else 0.0) for arm in body.arms]
        shape = Body(torso, (arms[0], arms[1]), body.legs, body.blend_m)
        around = azimuths(73)
        dress = outfit.bottom == "dress"
        tucked = dress or (outfit.bottom in ("trousers", "skirt") and rng.random() < 0.6)
        hem = 0.598 if tucked else float(rng.uniform(0.49, 0.56))
        depth = float(rng.uniform(0.0, 0.012)) if outfit.top == "sweater" else float(rng.uniform(0.008, 0.045))
        low = np.full_like(around, hem * H)
        high = neckline(around, H, depth, vee=bool(rng.random() < 0.35), wide=0.008 if outfit.top == "tank top" else 0)
        patches = [
            torso_sheet(self.wearer, shape, low, high, around, self._paint_top, self.folds(0.0035, 0.09, 0.13, 0))
        ]
        if sleeve > 0.05:
            folds = self.folds(0.0035, 0.05, 0.10, 1)
            patches += [limb_sheet(self.wearer, shape, 1 + i, -0.03, sleeve, self._paint_sleeve, folds) for i in (0, 1)]
        return patches

    def _paint_top(self, canvas: Canvas) -> Image:
        outfit = self.outfit
        image = outfit.fabrics[0].paint(canvas)
        second = outfit.fabrics[0].colors[1]
        y = canvas.y
        image = blend(image, 0.7 * image, edge(0.0015 - np.abs(y - 0.022), canvas))
        if outfit.top == "shirt":
            image = blend(image, 0.75 * image, edge(0.0015 - np.abs(np.abs(canvas.x) - 0.016), canvas))
            button = np.hypot(canvas.x, (y % 0.085) - 0.04)
            image = blend(image, 0.4 * second + 0.5, edge(0.006 - button, canvas))
        if outfit.lettering:
            image = write(image, canvas, outfit.lettering, second, (0.0, 0.62 * canvas.height_m), 0.24)
        return image

    def _paint_sleeve(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[0].paint(canvas)
        cuff = edge(0.0015 - np.abs(canvas.y - 0.02), canvas)
        return blend(image, 0.7 * image, cuff)

    def bottom(self) -> list[Patch]:
        """Trousers, shorts or skirt."""
        H, outfit, body = self.wearer.height_m, self.outfit, self.wearer.body
        rng = np.random.default_rng(outfit.seed + 1)
        if outfit.bottom in ("skirt", "dress"):
            return self._skirt(rng)
        kind = outfit.bottom
        ease = {"leggings": 0.002, "wide trousers": 0.012, "shorts": 0.011}.get(kind, 0.006 + 0.005 * rng.random())
        hang = {"leggings": 2.0, "wide trousers": 0.12, "shorts": 0.14}.get(kind, float(rng.choice([0.5, 0.35, 0.72])))
        flare = {"wide trousers": 0.01, "shorts": 0.008}.get(kind, float(rng.uniform(-0.012, 0.004)))
        end = float(rng.uniform(0.32, 0.5)) if kind == "shorts" else float(rng.uniform(0.93, 1.02))
        legs = [leg.eased(ease, hang, flare) for leg in body.legs]
        shape = Body(body.torso.eased(min(ease, 0.006) - 0.001), body.arms, (legs[0], legs[1]), body.blend_m)
        around = azimuths(73)
        waist = np.full_like(around, float(rng.uniform(0.592, 0.606)) * H)
        folds = self.folds(0.0 if kind == "leggings" else 0.0030, 0.06, 0.10, 2)
        patches = [
            torso_sheet(
                self.wearer, shape, np.full_like(around, 0.470 * H), waist, around, self._paint_waist, folds, 30
            )
        ]
        return patches + [
            limb_sheet(self.wearer, shape, 3 + i, -0.02, end, self._paint_leg, folds, rows=48) for i in (0, 1)
        ]

    def _paint_waist(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[1].paint(canvas)
        top = canvas.height_m - canvas.y
        image = blend(image, 0.65 * image, edge(0.0015 - np.abs(top - 0.036), canvas))
        belt = self.outfit.seed % 3 == 0
        if belt:
            leather = 0.4 * self.outfit.shoes[0] + np.array([0.06, 0.04, 0.03])
            image = blend(image, leather, edge(0.034 - top, canvas))
            image = blend(
                image,
                np.array([0.75, 0.7, 0.5]),
                edge(0.018 - np.maximum(np.abs(canvas.x), np.abs(top - 0.018)), canvas),
            )
        pocket = np.abs(np.abs(canvas.x) - 0.10 - 0.35 * (top - 0.04))
        inside = edge(top - 0.036, canvas) * edge(0.15 - top, canvas)
        image = blend(image, 0.6 * image, inside * edge(0.0018 - pocket, canvas))
        fly = edge(0.0014 - np.abs(canvas.x), canvas) * edge(top - 0.036, canvas) * edge(0.17 - top, canvas)
        return blend(image, 0.6 * image, fly)

    def _paint_leg(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[1].paint(canvas)
        # Seams run down the outer and inner side; jeans have bright stitches there.
        seam = np.abs(np.abs(canvas.x) - canvas.width_m / 4)
        image = blend(image, 0.72 * image, edge(0.0016 - seam, canvas))
        return blend(image, 0.75 * image, edge(0.0014 - np.abs(canvas.y - 0.025), canvas))

    def _skirt(self, rng: np.random.Generator) -> list[Patch]:
        H, outfit, body = self.wearer.height_m, self.outfit, self.wearer.body
        fabric = outfit.fabrics[0] if outfit.bottom == "dress" else outfit.fabrics[1]
        hem = float(rng.uniform(0.17, 0.36))
        flare = float(rng.uniform(0.14, 0.42))
        pleats = (int(rng.integers(7, 15)), float(rng.uniform(0.002, 0.014)))
        shape = Body(body.torso.eased(0.014, 0.0), body.arms, body.legs, body.blend_m)
        return skirt_sheets(self.wearer, shape, 0.606 * H, hem * H, azimuths(97), fabric.paint, flare, pleats)

    def outer(self) -> list[Patch]:
        """Jacket or coat, open in front."""
        H, outfit, body = self.wearer.height_m, self.outfit, self.wearer.body
        if outfit.outer == "none":
            return []
        rng = np.random.default_rng(outfit.seed + 2)
        ease = float(rng.uniform(0.026, 0.034))
        torso = body.torso.eased(ease, float(rng.uniform(0.5, 0.9)))
        arms = [arm.eased(ease - 0.004, 0.5) for arm in body.arms]
        shape = Body(torso, (arms[0], arms[1]), body.legs, body.blend_m)
        gap = float(rng.uniform(0.12, 0.4))
        around = azimuths(73, gap)
        coat = outfit.outer == "coat"
        hem = 0.555 if coat else float(rng.uniform(0.50, 0.55))
        high = neckline(around, H, 0.05, vee=True)
        folds = self.folds(0.004, 0.08, 0.12, 5)
        # No periodic folds: the front is open.
        patches = [
            torso_sheet(self.wearer, shape, np.full_like(around, hem * H), high, around, self._paint_outer, folds)
        ]
        patches.append(lining(patches[0]))
        patches += [limb_sheet(self.wearer, shape, 1 + i, -0.03, 0.97, outfit.fabrics[2].paint, folds) for i in (0, 1)]
        if coat:
            low = float(rng.uniform(0.2, 0.38))
            patches += skirt_sheets(
                self.wearer, shape, 0.56 * H, low * H, around, outfit.fabrics[2].paint, 0.16, (6, 0.003)
            )
        return patches

    def _paint_outer(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[2].paint(canvas)
        # The chart of an open garment begins and ends at the front's edges.
        front = canvas.width_m / 2 - np.abs(canvas.x)
        return blend(image, 0.6 * image, edge(0.002 - np.abs(front - 0.03), canvas))

    def shoes_rgb(self) -> Float[np.ndarray, "2 3"]:
        """Upper and sole."""
        return self.outfit.shoes


def lining(sheet: Patch) -> Patch:
    """The inside of an open sheet: a dark copy a few millimetres within, turned round."""
    inside = sheet.points[:, ::-1].copy()
    center = inside.mean(1, keepdims=True)
    inside = center + 0.975 * (inside - center)
    dark = np.broadcast_to(0.45 * sheet.chart.mean((0, 1)), (8, 8, 3))
    return Patch(inside, sheet.uv[:, ::-1], sheet.weights[:, ::-1], dark, closed=False)
