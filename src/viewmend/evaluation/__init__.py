"""Scores, tables and reports on fixed scenes."""
