"""Calibrations of others, a file each: every reader translates one into the content of a `cameras.json`."""
