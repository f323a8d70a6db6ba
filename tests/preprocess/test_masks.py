"""Masks of images that have none: each method, and what cleans them."""

import numpy as np
import pytest
import torch
from reference.ball import BallCapture, photograph, ring

from viewmend.geometry.cameras import Cameras
from viewmend.preprocess.masks.maker import ChromaMasks, MaskMaker, lasting, without_spill
from viewmend.preprocess.masks.masked import MaskedCapture, agreed
from viewmend.preprocess.masks.plate import PlateMasks, median_plate

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
    return (
        (rgb + np.random.default_rng(seed).normal(0, noise, rgb.shape)).round().clip(0, 255).astype(np.uint8)
    )


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


def test_a_screen_is_told_by_its_colour_in_light_and_shadow():
    screen = np.full((HEIGHT, WIDTH, 3), (30, 150, 60), float)
    screen *= np.linspace(0.5, 1.2, WIDTH)[None, :, None]
    mask = ChromaMasks("green").mask(image(screen.astype(np.uint8), shape()))
    assert iou(mask, shape()) > 0.95
    blue = screen[..., [0, 2, 1]].astype(np.uint8)
    assert iou(ChromaMasks("blue").mask(image(blue, shape())), shape()) > 0.95


def test_dark_walls_are_background_where_that_is_said():
    stage = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    stage[70:] = (30, 150, 60)
    rgb = image(stage, shape())
    assert iou(ChromaMasks("green", dark=True).mask(rgb), shape()) > 0.95
    assert iou(ChromaMasks("green").mask(rgb), shape()) < 0.3


def test_spill_goes_from_the_edge_and_stays_within():
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8) + np.uint8([20, 200, 40])
    rgb[30:100, 60:120] = (150, 170, 140)  # a grey coat that the screen tints
    rgb[60:70, 85:95] = (20, 180, 30)  # and a green badge
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[30:100, 60:120] = 255
    screen = np.zeros_like(rgb) + np.uint8([20, 200, 40])
    clean = without_spill(rgb, mask, screen)
    assert clean[50, 60].tolist() == [150, 150, 140] and clean[65, 90].tolist() == [20, 180, 30]
    grey = without_spill(rgb, mask, np.full_like(rgb, 120))
    assert np.array_equal(grey, rgb)  # a grey wall throws no green


def test_what_is_there_at_one_time_only_goes():
    mask = shape().astype(np.uint8) * 255
    flash = mask.copy()
    flash[5:15, 130:150] = 255
    moved = np.roll(mask, 3, axis=1)
    assert np.array_equal(lasting(flash, mask, moved), mask)
    assert np.array_equal(lasting(flash, flash, mask), flash)
    assert np.array_equal(lasting(flash, None, None), flash)  # a static capture has one time


def rig_masks() -> tuple[torch.Tensor, Cameras]:
    """Eight cameras round a ball."""
    frame = photograph(ring(8, 120))
    return frame.mask, frame.cameras


def test_cameras_drop_what_no_other_supports_and_fill_what_all_do():
    truth, cameras = rig_masks()
    spoilt = truth.clone()
    spoilt[0, 5:20, 5:20] = 255  # something behind that is no subject
    spoilt[3, 58:62, 58:63] = 0  # a hole of the background's colour
    cleaned = agreed(spoilt, cameras, None)
    assert not cleaned[0, 5:20, 5:20].any() and bool((cleaned[3, 58:62, 58:63] == 255).all())
    assert bool(((cleaned > 127) != (truth > 127)).float().mean() < 0.002)
    assert torch.equal(agreed(spoilt[:2], cameras[:2], None), spoilt[:2])


def test_one_empty_mask_among_eight_spoils_no_other():
    truth, cameras = rig_masks()
    spoilt = truth.clone()
    spoilt[5] = 0
    cleaned = agreed(spoilt, cameras, None)
    others = [view for view in range(8) if view != 5]
    agreement = ((cleaned > 127) & (truth > 127))[others].sum() / (truth > 127)[others].sum()
    assert float(agreement) > 0.99


def test_masks_whose_rays_diverge_support_nothing():
    """Side by side, without bounds: such as shadows at the outer edges of two images."""
    _, ball = rig_masks()
    side_by_side = torch.eye(4).repeat(3, 1, 1)
    side_by_side[:, 0, 3] = torch.tensor([0.0, -0.2, -0.4])
    cameras = Cameras(ball.names[:3], ball.K[:3], side_by_side, ball.size_px[:3])
    masks = torch.zeros(3, 120, 120, dtype=torch.uint8)
    masks[0, 50:70, :8] = 255
    masks[1, 50:70, 112:] = 255
    masks[2, 50:70, 50:70] = 255
    assert torch.equal(agreed(masks, cameras, None)[2], masks[2]), "as without the others"


class _Speck(MaskMaker):
    """Noise of a plate: a few pixels of an empty scene."""

    def __init__(self, is_noisy: bool) -> None:
        self.is_noisy = is_noisy

    def mask(self, rgb):
        mask = np.zeros(rgb.shape[:2], np.uint8)
        mask[30:40, 30:40] = 255 * self.is_noisy
        return mask


def test_what_one_camera_alone_sees_does_not_take_the_empty_masks_of_the_others():
    capture = BallCapture(ring(4, 120), 1)
    makers = {name: _Speck(name == capture.cameras.names[0]) for name in capture.cameras.names}
    frame = MaskedCapture(capture, makers, "pixels").read(0)
    assert frame.cameras.names == capture.cameras.names
