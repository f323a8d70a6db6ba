"""Fills the holes of free-viewpoint video, live."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viewmend.stream import Stream as Stream

__all__ = ["Stream"]


def __getattr__(name: str) -> object:
    """`viewmend.Stream`, imported when it is asked for: `import viewmend` alone stays instant."""
    if name == "Stream":
        from viewmend.stream import Stream

        return Stream
    raise AttributeError(f"module 'viewmend' has no attribute '{name}'")
