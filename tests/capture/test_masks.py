"""Masks of images that have none: by a plate, by a model of the background."""

import numpy as np
import pytest

from viewmend.capture.masks.maker import MaskMaker
from viewmend.capture.masks.model import ModelMasks
from viewmend.capture.masks.plate import PlateMasks, median_plate

HEIGHT, WIDTH = 120, 160


def plate(seed: int = 0) -> np.ndarray:
    """A wall of soft blotches over a green floor."""
    import cv2

    noise = np.random.default_rng(seed).integers(60, 200, (HEIGHT // 20, WIDTH // 20, 3), np.uint8)
    wall = cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    wall[HEIGHT // 2 :] = (60, 160, 90)
    return wall


def shape(x: int = 70) -> np.ndarray:
    inside = np.zeros((HEIGHT, WIDTH), bool)
    inside[30:100, x : x + 24] = True
    return inside


def image(background: np.ndarray, inside: np.ndarray, noise: float = 3.0, seed: int = 1) -> np.ndarray:
    """A red subject before the background, with a camera's noise."""
    rgb = np.where(inside[..., None], np.uint8([190, 40, 50]), background).astype(float)
    return (rgb + np.random.default_rng(seed).normal(0, noise, rgb.shape)).round().clip(0, 255).astype(np.uint8)


def iou(mask: np.ndarray, inside: np.ndarray) -> float:
    found = mask > 127
    return float((found & inside).sum() / (found | inside).sum())


def test_a_plate_tells_the_subject_with_soft_edges():
    maker = PlateMasks(plate())
    assert isinstance(maker, MaskMaker)
    mask = maker.mask(image(plate(), shape()))
    assert iou(mask, shape()) > 0.97
    soft = (mask > 0) & (mask < 255)
    assert 0 < soft.sum() < 5 * 2 * (70 + 24)
    assert not maker.mask(image(plate(), shape() & False)).any()


def test_shadows_and_wandering_exposure_are_no_subject():
    shaded = plate().astype(float)
    shaded[100:, 60:120] *= 0.7
    shadow = shaded.astype(np.uint8)
    maker = PlateMasks(plate())
    assert iou(maker.mask(image(shadow, shape())), shape()) > 0.95
    darker = (image(plate(), shape()) * 0.8).astype(np.uint8)
    assert iou(maker.mask(darker), shape()) > 0.95


def test_a_thin_hole_stays_open_and_a_speck_goes():
    inside = shape()
    inside[50:70, 78:86] = False
    speck = inside.copy()
    speck[10:12, 10:12] = True
    mask = PlateMasks(plate()).mask(image(plate(), speck))
    assert mask[60, 82] == 0 and not mask[5:20, 5:20].any()
    assert iou(mask, inside) > 0.93


def test_an_image_of_another_size_is_refused():
    with pytest.raises(ValueError, match="160 x 120 pixels as the plate has, got 80 x 60"):
        PlateMasks(plate()).mask(image(plate(), shape())[::2, ::2])
    with pytest.raises(ValueError, match="at least one image"):
        median_plate([])


@pytest.mark.parametrize("kind", ["mog2", "knn", "median"])
def test_a_model_learns_the_background_behind_who_moves(kind):
    maker = ModelMasks(kind, learning=False)
    assert not maker.mask(image(plate(), shape())).any()  # nothing is known yet
    for seed in range(30):
        maker.learn(image(plate(), shape(4 * seed), seed=seed))
    mask = maker.mask(image(plate(), shape(100), seed=99))
    assert iou(mask, shape(100)) > 0.9
    again = maker.mask(image(plate(), shape(100), seed=99))
    assert np.array_equal(mask, again)  # a model that does not learn gives the same again


def test_a_running_model_forgets_who_stays():
    maker = ModelMasks("mog2")
    for seed in range(20):
        maker.mask(image(plate(), shape() & False, seed=seed))
    first = maker.mask(image(plate(), shape(), seed=50))
    for seed in range(200):
        last = maker.mask(image(plate(), shape(), seed=seed))
    assert iou(first, shape()) > 0.9 and not last.any()
