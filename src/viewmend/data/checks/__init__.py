"""Checks of the masks, the calibration, the images and the timing of a capture."""
