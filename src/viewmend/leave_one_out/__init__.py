"""Scenes with a camera that is left out and its truth, for training and evaluation alike."""
