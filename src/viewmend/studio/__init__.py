"""A capture stage in software that gives exact truth."""
