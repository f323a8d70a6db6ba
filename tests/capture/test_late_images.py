"""Images are late only where those of another time are nearer to what others saw."""

import pytest
from reference.ball import BallCapture, ring

from viewmend.capture.peers import late_images


@pytest.mark.parametrize("count", [1, 3])
def test_a_camera_that_shares_no_surface_with_others_is_in_time(count):
    """Four cameras about a ball: no two see enough of the same points to be compared."""
    frame = BallCapture(ring(4)).read(0)
    assert late_images([frame] * count, count // 2, None) == ()
