"""What is found wrong with a capture."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, in words."""

    text: str
    """What was expected, what came, the next step."""
    fatal: bool = False
    """Nothing useful can be rendered from such a capture."""
    camera: str | None = None
    """The camera to leave out; the others are right."""
    always: bool = False
    """The camera's calibration is in doubt, so that no time is better than another."""
