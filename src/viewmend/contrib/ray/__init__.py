"""Evaluation and live serving on a Ray cluster."""
