"""Comparisons on fixed scenes."""
