"""Masks, calibration and colour matching."""
