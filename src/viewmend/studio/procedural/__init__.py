"""Procedural performers: clothed, articulated people drawn from a seed, with nothing to download."""

from viewmend.studio.procedural.performer import PerformerStyle, procedural_scene

__all__ = ["PerformerStyle", "procedural_scene"]
