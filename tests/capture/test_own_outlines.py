"""Images are in time with the masks whose outlines lie on their edges."""

import pytest
import torch
from reference.ball import BallCapture, ring

from viewmend.capture.own_outlines import delay_text, images_out_of_time
from viewmend.views import MultiViewFrame


def moving(times: range, late: int = 0, view: int = 1, size: int = 64) -> list[MultiViewFrame]:
    """Two cameras before a chequered wall; a bright square walks two pixels a frame, in one camera's images later."""
    cameras = ring(2, size)
    grid = torch.arange(size) // 4 % 2
    wall = 40 * (grid[:, None] ^ grid[None]).byte()

    def at(time: int) -> torch.Tensor:
        inside = torch.zeros(size, size, dtype=torch.bool)
        inside[20:44, 10 + 2 * time : 26 + 2 * time] = True
        return inside

    frames = []
    for time in times:
        masks = torch.stack([at(time), at(time)])
        shown = masks.clone()
        shown[view] = at(time - late)
        rgb = torch.where(shown, 200, wall).byte()[:, None].repeat(1, 3, 1, 1)
        frames.append(MultiViewFrame(cameras, rgb, 255 * masks.byte(), time))
    return frames


@pytest.mark.parametrize("late", [-3, -1, 1, 2, 4])
@pytest.mark.parametrize("view", [0, 1])
def test_images_that_fit_their_masks_of_another_time_are_named(late, view):
    (found,) = images_out_of_time(moving(range(9), late, view))
    assert f"'c{view}': {delay_text(late)} against its masks" in found.text
    assert not found.camera and not found.fatal  # nothing is left out for it


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_images_in_time_are_not(count):
    assert images_out_of_time(moving(range(count))) == ()
    still = BallCapture(ring(4)).read(0)
    assert images_out_of_time([still] * count) == ()


@pytest.mark.parametrize("time", [0, 2, 4])
def test_one_spoilt_image_is_not_a_delay(time):
    frames = moving(range(5))
    frames[time].rgb[1] //= 8
    assert images_out_of_time(frames) == ()


def test_too_few_times_say_nothing():
    assert images_out_of_time(moving(range(3), 1)) == ()
    assert len(images_out_of_time(moving(range(4), 1))) == 1


def test_without_masks_nothing_is_said():
    frames = moving(range(9), 2)
    assert images_out_of_time([MultiViewFrame(f.cameras, f.rgb, None, f.time) for f in frames]) == ()


@pytest.mark.parametrize("by, words", [(1, "late by about 1 frame"), (-3, "early by about 3 frames")])
def test_a_delay_in_words(by, words):
    assert delay_text(by) == words
