"""Exports: models for other runtimes, and scenes for 3D engines."""
