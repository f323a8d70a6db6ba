"""Foreground masks for captures that have none; one method per file."""
