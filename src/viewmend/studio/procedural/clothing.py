"""The tailor: garments cut from the body's own shape and painted with cloth."""

from dataclasses import dataclass, replace

import numpy as np

from viewmend.studio.procedural.body import Body, Limb, Torso
from viewmend.studio.procedural.fabric import Canvas, Image, blend, edge, write
from viewmend.studio.procedural.outfit import Cut, Outfit
from viewmend.studio.procedural.patches import Patch
from viewmend.studio.procedural.sheets import Azimuths, Folds, Wearer, azimuths, limb_sheet, skirt_sheets, torso_sheet


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
    cut: Cut

    def folds(self, depth_m: float, along_m: float, around_m: float, number: int) -> Folds:
        """Creases with a seed of their own."""
        return Folds(depth_m, along_m, around_m, self.outfit.seed % 100_000 + 17 * number)

    def lower_shape(self) -> Body:
        """The body in what covers the legs."""
        body, cut = self.wearer.body, self.cut
        legs = [leg.eased(cut.ease_m, cut.leg_hang, cut.leg_flare_m) for leg in body.legs]
        return Body(body.torso.eased(min(cut.ease_m, 0.006) - 0.001), body.arms, (legs[0], legs[1]), body.blend_m)

    def _trunk(self, under: Torso) -> Torso:
        """The trunk in the top, over what is tucked into it."""
        return self.wearer.body.torso.eased(self.cut.loose_m, self.cut.hang, 0.004).outside(under, 0.005)

    def _sleeves(self) -> tuple[Limb, Limb]:
        short, ease = self.cut.sleeve < 0.7, self.cut.loose_m + 0.003
        hang, flare = (0.10, 0.012) if short else (0.62, -0.006)
        left, right = (arm.eased(ease, hang, flare) for arm in self.wearer.body.arms)
        return left, right

    def top(self) -> list[Patch]:
        """Shirt, sweater or the like: trunk and sleeves."""
        H, outfit, body, cut = self.wearer.height_m, self.outfit, self.wearer.body, self.cut
        lower = self.lower_shape()
        legs = [leg.eased(0.004) for leg in lower.legs]
        shape = Body(self._trunk(lower.torso), self._sleeves(), (legs[0], legs[1]), body.blend_m)
        around = azimuths(65)
        wide = 0.008 if outfit.top == "tank top" else 0.0
        high = neckline(around, H, cut.neck, cut.vee, wide)
        low = np.full_like(around, cut.top_hem * H)
        folds = self.folds(0.0022, 0.10, 0.16, 0)
        trunk = torso_sheet(self.wearer, shape, low, high, around, self._paint_top, folds, 40)
        start = -0.03
        if outfit.outer != "none":
            # Only what an open front and the hems show: the rest could but poke through.
            start = 0.8
            shown = np.broadcast_to(np.abs(around) < 0.9, trunk.points.shape[:2]).copy()
            shown[:6] = shown[-5:] = True
            trunk = replace(trunk, keep=shown)
        if cut.sleeve <= max(start, 0.05):
            return [trunk]
        folds = self.folds(0.0022, 0.06, 0.12, 1)
        rows = 20 if cut.sleeve < 0.7 or start > 0 else 40
        return [trunk] + [
            limb_sheet(self.wearer, shape, 1 + i, start, cut.sleeve, self._paint_sleeve, folds, (rows, 25))
            for i in (0, 1)
        ]

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
        H, cut, kind = self.wearer.height_m, self.cut, self.outfit.bottom
        if kind in ("skirt", "dress"):
            return self._skirt()
        shape = self.lower_shape()
        around = azimuths(65)
        # Under a hanging shirt the waistband is nowhere to be seen, and nothing can poke through.
        waist = 0.602 if cut.top_hem > 0.58 else cut.top_hem + 0.035
        folds = self.folds(0.0 if kind == "leggings" else 0.0020, 0.08, 0.12, 2)
        low, high = (np.full_like(around, share * H) for share in (0.470, waist))
        patches = [torso_sheet(self.wearer, shape, low, high, around, self._paint_waist, folds, 26)]
        rows = 24 if kind == "shorts" else 44
        return patches + [
            limb_sheet(self.wearer, shape, 3 + i, -0.02, cut.leg, self._paint_leg, folds, (rows, 29)) for i in (0, 1)
        ]

    def _paint_waist(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[1].paint(canvas)
        top = canvas.height_m - canvas.y
        image = blend(image, 0.65 * image, edge(0.0015 - np.abs(top - 0.036), canvas))
        if self.outfit.seed % 3 == 0:
            leather = 0.4 * self.outfit.shoes[0] + np.array([0.06, 0.04, 0.03])
            image = blend(image, leather, edge(0.034 - top, canvas))
            buckle = np.maximum(np.abs(canvas.x), np.abs(top - 0.018))
            image = blend(image, np.array([0.75, 0.7, 0.5]), edge(0.018 - buckle, canvas))
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

    def _skirt(self) -> list[Patch]:
        H, outfit, body = self.wearer.height_m, self.outfit, self.wearer.body
        rng = np.random.default_rng(outfit.seed + 1)
        fabric = outfit.fabrics[0] if outfit.bottom == "dress" else outfit.fabrics[1]
        hem = float(rng.uniform(0.17, 0.36))
        flare = float(rng.uniform(0.14, 0.42))
        pleats = (int(rng.integers(7, 15)), float(rng.uniform(0.002, 0.014)))
        shape = Body(body.torso.eased(0.014, 0.0), body.arms, body.legs, body.blend_m)
        waist = 0.606 if self.cut.top_hem > 0.58 else self.cut.top_hem + 0.02
        return skirt_sheets(self.wearer, shape, waist * H, hem * H, azimuths(97), fabric.paint, flare, pleats)

    def outer(self) -> list[Patch]:
        """Jacket or coat, open in front."""
        H, outfit, body = self.wearer.height_m, self.outfit, self.wearer.body
        if outfit.outer == "none":
            return []
        rng = np.random.default_rng(outfit.seed + 2)
        ease = float(rng.uniform(0.026, 0.034))
        torso = body.torso.eased(ease, float(rng.uniform(0.5, 0.9)))
        torso = torso.outside(self._trunk(self.lower_shape().torso), 0.012)
        arms = [arm.eased(ease - 0.004, 0.55, -0.004) for arm in body.arms]
        shape = Body(torso, (arms[0], arms[1]), body.legs, body.blend_m)
        gap = float(rng.uniform(0.12, 0.4))
        around = azimuths(65, gap)
        coat = outfit.outer == "coat"
        hem = 0.535 if coat else float(rng.uniform(0.50, 0.55))
        high = neckline(around, H, 0.05, vee=True)
        folds = self.folds(0.0025, 0.09, 0.14, 5)
        patches = [
            torso_sheet(self.wearer, shape, np.full_like(around, hem * H), high, around, self._paint_outer, folds)
        ]
        patches.append(lining(patches[0]))
        patches += [limb_sheet(self.wearer, shape, 1 + i, -0.03, 0.97, outfit.fabrics[2].paint, folds) for i in (0, 1)]
        if coat:
            low = float(rng.uniform(0.2, 0.38))
            patches += skirt_sheets(
                self.wearer, shape, 0.575 * H, low * H, around, outfit.fabrics[2].paint, 0.16, (6, 0.003)
            )
        return patches

    def _paint_outer(self, canvas: Canvas) -> Image:
        image = self.outfit.fabrics[2].paint(canvas)
        # The chart of an open garment begins and ends at the front's edges.
        front = canvas.width_m / 2 - np.abs(canvas.x)
        return blend(image, 0.6 * image, edge(0.002 - np.abs(front - 0.03), canvas))


def lining(sheet: Patch) -> Patch:
    """The inside of an open sheet near its front edges: a dark copy a few millimetres within, turned round."""
    inside = sheet.points[:, ::-1].copy()
    center = inside.mean(1, keepdims=True)
    inside = center + 0.975 * (inside - center)
    edge_columns = np.arange(inside.shape[1])
    near = np.minimum(edge_columns, edge_columns[::-1]) < 7
    keep = np.broadcast_to(near, inside.shape[:2])
    dark = np.broadcast_to(0.45 * sheet.chart.mean((0, 1)), (8, 8, 3))
    return Patch(inside, sheet.uv[:, ::-1], sheet.weights[:, ::-1], dark, keep, closed=False)
