"""Whole views read from the cameras: places along all rays are looked up, weighed, and blended at the best. Ours."""
