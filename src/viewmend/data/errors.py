"""Errors and issues of captures."""

from collections.abc import Iterable
from dataclasses import dataclass

from viewmend.utils.untrusted_input import InputError


class CaptureError(InputError):
    """A capture that cannot be used. The message states what was expected, what was found, and what to do next.

    Examples:
        >>> from viewmend import CaptureError, open_capture
        >>> try:
        ...     open_capture("nowhere")
        ... except CaptureError as error:
        ...     print("check the path" in str(error))
        True
    """


@dataclass(frozen=True)
class Issue:
    """A fault that a check has found in a capture."""

    text: str
    """What was expected, what was found, and what to do next."""
    fatal: bool = False
    """Whether rendering the capture is pointless."""
    camera: str | None = None
    """The camera to leave out; the other cameras are correct."""
    always: bool = False
    """Whether to leave the camera out of all frames, because its calibration is in doubt."""
    odd_image: str | None = None
    """The camera whose image differs from the others', so that their colours are not matched to it."""
    timing: bool = False
    """Whether a late camera, this one or another, would explain the fault."""


def without_consequences(issues: Iterable[Issue], late: Iterable[Issue]) -> tuple[Issue, ...]:
    """The issues, without those that the late cameras explain."""
    return tuple(issue for issue in issues if not (issue.timing and any(late)))
