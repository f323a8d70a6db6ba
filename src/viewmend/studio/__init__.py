"""A software studio that renders captures with exact ground truth."""
