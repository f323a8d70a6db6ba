"""Frame and target camera to `IncompleteView`: camera selection, blending, error mask."""
