"""Films show the subject, and all of it."""

import numpy as np
import torch

from viewmend.evaluation.film import FILM_PX, Box, film, frames_of, subject_box


def test_a_box_is_around_all_pixels_with_a_margin():
    subject = torch.zeros(200, 300, dtype=torch.bool)
    assert subject_box(subject) is None
    subject[50, 60] = subject[149, 99] = True
    assert subject_box(subject) == Box(44, 54, 156, 106), "6 % of a hundred rows"
    subject[0, 299] = True
    assert subject_box(subject) == Box(0, 46, 164, 300), "an image ends"
    assert Box(1, 5, 20, 30).around(Box(2, 3, 25, 28)) == Box(1, 3, 25, 30)


def test_frames_are_cut_to_the_box_and_made_small_but_never_large():
    frames = [np.zeros((600, 400, 3), np.uint8) for _ in range(3)]
    for n, frame in enumerate(frames):
        frame[100:612, 200:328] = 50 + 50 * n
    strip = film(frames, Box(100, 200, 600, 328))
    assert strip is not None and strip.shape == (3 * FILM_PX, round(128 * FILM_PX / 500), 3)
    assert [float(part.mean()) for part in frames_of(strip, 3)] == [50, 100, 150]
    assert film(frames, None).shape == (3 * FILM_PX, round(400 * FILM_PX / 600), 3)
    assert film(frames, Box(0, 0, 40, 30)).shape == (120, 30, 3)
    assert film([np.zeros((40, 30, 3), np.uint8)], None).shape == (40, 30, 3), "the whole image"
    assert film([], None) is None and frames_of(strip, 5) == []
