"""Camera calibration from a board, refined by silhouettes."""
