"""What is said of a capture as it was prepared: a shift of all its images, and matched colours."""

from typing import TYPE_CHECKING

from viewmend.cli.console import say
from viewmend.geometry.alignment import LEAST_IOU

if TYPE_CHECKING:
    from viewmend.capture.prepare import PreparedCapture


def say_prepared(capture: "PreparedCapture") -> None:
    """Say by how much the images were shifted, whether hull and masks agree at all, and whether colours are matched."""
    if capture.colours is not None:
        say(capture.colours.said)
    found = capture.alignment
    if found is None:
        return
    if found.offset_px != (0.0, 0.0):
        x, y = found.offset_px
        say(
            f"all principal points moved by ({x:+.2f}, {y:+.2f}) pixels: hull and masks then agree better, IoU "
            f"{found.iou_before:.3f} -> {found.iou_after:.3f}; check first_pixel_center, or use --no-align"
        )
    if found.iou_after < LEAST_IOU:
        say(
            f"the hull hardly agrees with the first masks, IoU {found.iou_after:.3f}: a mask or a camera is wrong; "
            "look at it with viewmend info --out"
        )
