"""Inpainters: the base class, the registry, and the models."""
