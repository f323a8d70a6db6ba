"""Masks for images that have none: one method a file, each an object that makes a mask of one camera's next image."""
