"""Fixtures of the live server's tests."""

from live.live_servers import ball, ball_view

__all__ = ["ball", "ball_view"]
