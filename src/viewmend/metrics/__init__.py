"""Image quality, whole image and holes."""
