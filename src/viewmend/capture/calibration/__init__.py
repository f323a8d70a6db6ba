"""Cameras found: from a board that is moved about before them, and refined by silhouettes."""
