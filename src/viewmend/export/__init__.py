"""Scenes and models in the formats of other people's systems."""
