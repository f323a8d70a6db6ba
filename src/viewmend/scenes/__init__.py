"""Scenes with one camera held out as ground truth, for training and evaluation."""
