"""Who it is: height, sex, build, skin, and the skeleton that follows from them."""

from dataclasses import dataclass

import numpy as np

from viewmend.studio.procedural.skeleton import ARM, ARM_ANGLE_RAD, JOINTS, SIDES, SIGN, SKIRT_COLUMNS, Skeleton, Values
from viewmend.studio.procedural.tables import TABLES


@dataclass(frozen=True, kw_only=True)
class Physique:
    """A person's build. Lengths elsewhere are fractions of `height_m` unless they say metres."""

    height_m: float
    femininity: float
    """0 masculine, 1 feminine: shoulders, hips, waist, bust, neck, jaw."""
    weight: float
    """-1 thin, 0 average, 1.6 heavy."""
    muscle: float
    """0 to 1."""
    leg_share: float
    """Length of the legs relative to the average."""
    skin_rgb: tuple[float, float, float]
    """sRGB."""
    face: tuple[float, ...]
    """Eight numbers in [-1, 1]: the features' individual sizes and places."""


SKIN_RGB = np.array(TABLES["skin"])


def sample_physique(rng: np.random.Generator) -> Physique:
    """Draw a person."""
    feminine = bool(rng.random() < 0.5)
    height = rng.normal(1.66, 0.07) if feminine else rng.normal(1.78, 0.08)
    tone = rng.uniform(0, len(SKIN_RGB) - 1)
    skin = [float(np.interp(tone, np.arange(len(SKIN_RGB)), SKIN_RGB[:, c])) for c in range(3)]
    return Physique(
        height_m=float(np.clip(height, 1.5, 1.95)),
        femininity=float(np.clip(rng.normal(0.92 if feminine else 0.08, 0.08), 0, 1)),
        weight=float(np.clip(rng.normal(0.1, 0.5), -0.8, 1.6)),
        muscle=float(rng.uniform(0.1, 0.9)),
        leg_share=float(np.clip(rng.normal(1.0, 0.025), 0.95, 1.05)),
        skin_rgb=(skin[0], skin[1], skin[2]),
        face=tuple(float(v) for v in rng.uniform(-1, 1, 8)),
    )


def build_skeleton(person: Physique) -> Skeleton:
    """Bind positions of the joints of this person."""
    places: dict[str, tuple[float, float, float]] = {
        "pelvis": (0, 0.535, 0),
        "spine": (0, 0.585, 0.002),
        "chest": (0, 0.66, -0.004),
        "upper": (0, 0.74, -0.012),
        "neck": (0, 0.835, -0.014),
        "head": (0, 0.878, -0.002),
        "tail": (0, 0.96, -0.052),
    }
    shoulder = 0.106 - 0.011 * person.femininity + 0.003 * person.muscle
    hip = 0.049 + 0.004 * person.femininity
    arm = np.array([np.sin(ARM_ANGLE_RAD), -np.cos(ARM_ANGLE_RAD), 0.0])
    for side in SIDES:
        s = SIGN[side]
        mirror = np.array([s, 1, 1])
        start = np.array([shoulder, 0.795, -0.013])
        places[f"{side}_clavicle"] = (s * 0.018, 0.80, -0.004)
        for part, reach in (("upperarm", 0.0), ("forearm", 0.168), ("hand", 0.312), ("fingers", 0.366)):
            x, y, z = (start + reach * arm) * mirror
            places[f"{side}_{part}"] = (x, y, z)
        places[f"{side}_thigh"] = (s * hip, 0.522, 0.0)
        places[f"{side}_shin"] = (s * (hip + 0.006), 0.281, 0.004)
        places[f"{side}_foot"] = (s * (hip + 0.010), 0.043, -0.010)
        places[f"{side}_toe"] = (s * (hip + 0.014), 0.010, 0.068)
    for column in range(SKIRT_COLUMNS):
        azimuth = 2 * np.pi * column / SKIRT_COLUMNS
        x, z = np.sin(azimuth), np.cos(azimuth)
        places[f"skirt{column}_high"] = (0.07 * x, 0.57, 0.045 * z)
        places[f"skirt{column}_low"] = (0.09 * x, 0.40, 0.07 * z)
    positions = np.array([places[name] for name in JOINTS], dtype=np.float64)
    trunk = np.array([not name.endswith(ARM) for name in JOINTS])
    positions[trunk, 1] = leg_stretch(positions[trunk, 1], person.leg_share)
    return Skeleton(positions * person.height_m)


def leg_stretch(y: Values, share: float) -> Values:
    """Heights (fractions) after the legs take `share` of their length; ankles, shoulders and head stay."""
    return np.interp(y, [0.0, 0.043, 0.522, 0.797, 1.0], [0.0, 0.043, 0.522 * share, 0.797, 1.0])
