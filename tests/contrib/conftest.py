"""Fixtures of the tests of optional parts."""

from live.live_servers import ball, ball_view

__all__ = ["ball", "ball_view"]
