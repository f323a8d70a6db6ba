"""Samples, losses, recipes and the loop."""
