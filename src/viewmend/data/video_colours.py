"""Conversion of a video's colours to sRGB, by the primaries and the transfer function that it declares.

Phones record HDR (HLG or PQ with the primaries of BT.2020) by default. The numbers are ITU-T H.273's codes.
"""

import functools

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16

PQ = 16
"""Code of the transfer function of SMPTE ST 2084 (codes of ITU-T H.273, as all that follow)."""
HLG = 18
"""Code of the transfer function of ARIB STD-B67."""
LINEAR = 8
"""Code of linear light."""
BT2020 = 9
"""Code of the primaries of ITU-R BT.2020."""
DCI_P3 = 11
"""Code of the primaries of SMPTE RP 431-2."""
DISPLAY_P3 = 12
"""Code of the primaries of SMPTE EG 432-1."""
PQ_WHITE_NITS = 203.0
"""Luminance of standard white in PQ, cd/m2 (ITU-R BT.2408)."""
PQ_PEAK_NITS = 10000.0
"""Luminance of the largest PQ value, cd/m2."""
HLG_WHITE = 0.75
"""HLG value of standard white (ITU-R BT.2408)."""
LINEAR_STEPS = 2**14
"""Steps of the table from linear light to sRGB."""
TO_BT709 = {
    BT2020: ((1.6605, -0.5876, -0.0728), (-0.1246, 1.1329, -0.0083), (-0.0182, -0.1006, 1.1187)),
    DCI_P3: ((1.2249, -0.2247, 0.0), (-0.0420, 1.0419, 0.0), (-0.0197, -0.0786, 1.0979)),
    DISPLAY_P3: ((1.2249, -0.2247, 0.0), (-0.0420, 1.0419, 0.0), (-0.0197, -0.0786, 1.0979)),
}
"""Matrices that convert linear RGB of other primaries to that of BT.709 and sRGB, all with white D65."""


def is_srgb(primaries: int, transfer: int) -> bool:
    """Whether colours can be shown as they are: other transfer functions of standard range are close to sRGB's."""
    return primaries not in TO_BT709 and transfer not in (PQ, HLG, LINEAR)


def to_srgb(
    rgb: UInt16[np.ndarray, "height width 3"], primaries: int, transfer: int
) -> UInt8[np.ndarray, "height width 3"]:
    """Convert RGB of 16 bits in full range to 8-bit sRGB; what is brighter than standard white becomes white."""
    linear = _linear_light(transfer)[rgb]
    if primaries in TO_BT709:
        linear = np.asarray(cv2.transform(linear, np.array(TO_BT709[primaries], np.float32)))
    steps = (linear.clip(0, 1) * (LINEAR_STEPS - 1) + 0.5).astype(np.uint16)
    return _srgb_values()[steps]


@functools.cache
def _linear_light(transfer: int) -> Float32[np.ndarray, "65536"]:
    """Linear light of each 16-bit value, where 1 is standard white."""
    value = np.linspace(0, 1, 2**16)
    if transfer == PQ:
        power = value ** (1 / 78.84375)
        light = (np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)) ** (1 / 0.1593017578125)
        light = light * PQ_PEAK_NITS / PQ_WHITE_NITS
    elif transfer == HLG:
        light = _hlg_light(value) / _hlg_light(np.array(HLG_WHITE))
    elif transfer == LINEAR:
        light = value
    else:
        light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


def _hlg_light(value: np.ndarray) -> np.ndarray:
    """Scene light of HLG values, 0 to 1: the inverse of the transfer function of ITU-R BT.2100."""
    bright = (np.exp((value - 0.55991073) / 0.17883277) + 0.28466892) / 12
    return np.where(value <= 0.5, value**2 / 3, bright)


@functools.cache
def _srgb_values() -> UInt8[np.ndarray, "16384"]:
    """The 8-bit sRGB value of each step of linear light."""
    light = np.linspace(0, 1, LINEAR_STEPS)
    value = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * value).astype(np.uint8)
