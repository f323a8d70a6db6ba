"""What is worn: garments, cloth, colours and measures drawn from a seed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from viewmend.studio.procedural.fabric import QUIET, WORDS, Fabric, hsv, sample_fabric

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
    """Fabrics of top, bottom and outer."""
    lettering: str
    """Across the chest; empty for none."""
    shoes: Float[np.ndarray, "2 3"]
    """Upper and sole, sRGB."""
    seed: int

    @property
    def words(self) -> str:
        """The outfit in words."""
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
    if outer == "coat" and bottom in ("skirt", "dress"):
        outer = "jacket"  # a wide skirt has no room under a coat
    lower = sample_fabric(rng, ("denim",) if bottom == "jeans" else LOWER)
    fabrics = (sample_fabric(rng), lower, sample_fabric(rng, LOOSE))
    written = bottom != "dress" and outer == "none" and fabrics[0].kind in QUIET and rng.random() < 0.6
    lettering = WORDS[int(rng.integers(len(WORDS)))] if written else ""
    light = rng.random() < 0.5
    upper = hsv(rng.random(), rng.uniform(0, 0.7) * (rng.random() < 0.5), rng.uniform(0.1, 0.95))
    sole = np.full(3, 0.9) if light else np.full(3, 0.12)
    return Outfit(top, bottom, outer, fabrics, lettering, np.stack([upper, sole]), int(rng.integers(2**31)))


@dataclass(frozen=True)
class Cut:
    """The measures of an outfit: metres of ease, shares of the height for hems, shares of the limb for sleeves."""

    loose_m: float
    hang: float
    sleeve: float
    top_hem: float
    neck: float
    vee: bool
    ease_m: float
    leg: float
    cuff: float
    """Where the skin of the arm shows from: the end of the longest sleeve."""
    leg_hang: float
    leg_flare_m: float


def sample_cut(outfit: Outfit) -> Cut:
    """Draw the measures that suit these garments."""
    rng = np.random.default_rng(outfit.seed)
    loose = {"sweater": 0.014, "shirt": 0.010, "t-shirt": 0.009}.get(outfit.top, 0.004) + 0.006 * rng.random()
    sleeve = {"t-shirt": rng.uniform(0.2, 0.42), "tank top": 0.0}.get(outfit.top, rng.uniform(0.94, 1.0))
    if outfit.top == "shirt" and outfit.outer == "none" and rng.random() < 0.3:
        sleeve = rng.uniform(0.5, 0.6)
    kind = outfit.bottom
    tucked = kind == "dress" or (kind in ("trousers", "skirt") and rng.random() < 0.6)
    end = {"shorts": rng.uniform(0.32, 0.5), "skirt": 0.0, "dress": 0.0}.get(kind, rng.uniform(0.95, 1.03))
    flares: dict[str, float] = {"wide trousers": 0.02, "shorts": 0.004}
    eases: dict[str, float] = {"leggings": 0.002, "wide trousers": 0.010, "shorts": 0.011}
    hangs: dict[str, float] = {"leggings": 2.0, "wide trousers": 0.3, "shorts": 0.2}
    return Cut(
        loose_m=float(loose),
        hang=0.2 if outfit.top == "tank top" or kind == "dress" else float(rng.uniform(0.3, 0.9)),
        sleeve=float(sleeve),
        top_hem=0.598 if tucked else float(rng.uniform(0.49, 0.56)),
        neck=float(rng.uniform(0.0, 0.012) if outfit.top == "sweater" else rng.uniform(0.008, 0.045)),
        vee=bool(rng.random() < 0.35),
        ease_m=eases[kind] if kind in eases else float(rng.uniform(0.006, 0.011)),
        leg=float(end),
        cuff=float(sleeve if outfit.outer == "none" else max(sleeve, 0.97)),
        leg_hang=hangs[kind] if kind in hangs else float(rng.choice([0.5, 0.35, 0.72])),
        leg_flare_m=flares[kind] if kind in flares else float(rng.uniform(-0.012, 0.004)),
    )
