"""What is said of a capture as it was prepared: a shift of all its images, and matched colours."""

from typing import TYPE_CHECKING

from viewmend.cli.console import say
from viewmend.geometry.alignment import LEAST_IOU

if TYPE_CHECKING:
    from viewmend.capture.prepare import PreparedCapture


def say_prepared(capture: "PreparedCapture") -> None:
    """Say what was changed of a capture, and whether hull and masks agree at all."""
    for text in capture.changes:
        say(text)
    if capture.alignment is not None and capture.alignment.iou_after < LEAST_IOU:
        say(
            f"the hull hardly agrees with the first masks, IoU {capture.alignment.iou_after:.3f}: a mask or a camera "
            "is wrong; look at it with viewmend info --out"
        )
