"""Adds imperfections of real stages, optional and seeded: colour, noise, compression, masks, calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.rigid import rotation_from_axis_angle
from viewmend.types import MultiViewFrame
from viewmend.utils.srgb import linear_from_srgb, srgb_from_linear

Picture = UInt8[Tensor, "3 height width"]
Mask = UInt8[Tensor, "height width"]
Backdrop = Float[Tensor, "3 height width"]
Seeds = tuple[int, int, int]
"""Seeds of the capture, the camera's position, and the time."""
SPILL_PX = 3.0
"""Standard deviation of the blur that measures the distance to the outline."""


@dataclass(frozen=True, kw_only=True)
class Imperfections:
    """Strengths of the imperfections; all are off by default."""

    exposure_stops: float = 0.0
    """Standard deviation of the cameras' exposure, in powers of two; constant in time."""
    white_balance: float = 0.0
    """Standard deviation of each camera's gain per colour channel, as a share; constant in time."""
    shot_noise: float = 0.0
    """Standard deviation of the noise at white, in [0, 1] of sRGB; it falls with the root of the signal."""
    read_noise: float = 0.0
    """Standard deviation of the noise at black, in [0, 1] of sRGB."""
    spill: float = 0.0
    """Strength of the background's colour on the subject near its outline, in [0, 1]; needs a
    background."""
    jpeg_quality: int | None = None
    """Compress the images at this quality, 1 to 100; None for no compression."""
    mask_edge_px: float = 0.0
    """Standard deviation of the wandering of mask outlines, and their softness, in pixels."""
    mask_holes: float = 0.0
    """Mean number of spots of missing foreground per mask."""
    mask_blobs: float = 0.0
    """Mean number of spots of false foreground per mask."""
    mask_hard: bool = False
    """Threshold masks at one half, as recorded ones often are, instead of soft outlines."""
    calibration_px: float = 0.0
    """Standard deviation of the cameras' wrong orientation, as pixels in the image; constant in time."""
    calibration_m: float = 0.0
    """Standard deviation of the cameras' wrong position per axis, metres; constant in time."""

    @classmethod
    def typical(cls) -> "Imperfections":
        """Imperfections of an average real stage."""
        return cls(
            exposure_stops=0.08,
            white_balance=0.02,
            shot_noise=0.012,
            read_noise=0.004,
            spill=0.3,
            jpeg_quality=90,
            mask_edge_px=0.7,
            mask_holes=0.3,
            mask_blobs=0.3,
            calibration_px=0.3,
            calibration_m=0.001,
        )


def imperfect_cameras(cameras: Cameras, imperfections: Imperfections, seed: int) -> Cameras:
    """Perturb a calibration: what a capture would state of cameras that truly stand elsewhere."""
    if imperfections.calibration_px == 0 and imperfections.calibration_m == 0:
        return cameras
    wrong = cameras.camera_from_world.clone()
    for n in range(len(cameras)):
        draw = torch.randn(2, 3, generator=_generator(seed, 1, n, 0)).to(wrong)
        angle = draw[0] * imperfections.calibration_px / cameras.K[n, 0, 0]
        wrong[n, :3] = rotation_from_axis_angle(angle) @ wrong[n, :3]
        wrong[n, :3, 3] += imperfections.calibration_m * draw[1]
    return replace(cameras, camera_from_world=wrong)


def imperfect_frame(
    frame: MultiViewFrame,
    imperfections: Imperfections,
    seed: int,
    background: Float[Tensor, "view 3 height width"] | None = None,
    numbers: Sequence[int] | None = None,
) -> MultiViewFrame:
    """Apply the imperfections to a frame; its depth and calibration stay true.

    Args:
        frame: with masks.
        imperfections: what is wrong.
        seed: of the capture; the same seed, camera position and time give the same errors.
        background: what the images have behind the subject, linear light; only `spill` uses it.
        numbers: the cameras' positions in the rig; None if the frame has the whole rig.
    """
    if imperfections == Imperfections():
        return frame
    assert frame.mask is not None, "studio frames always have masks"
    rgb = []
    mask = []
    for n, (width, height) in enumerate(frame.cameras.size_px.tolist()):
        image = frame.rgb[n, :, :height, :width]
        cover = frame.mask[n, :height, :width]
        behind = None if background is None else background[n, :, :height, :width]
        seeds = (seed, n if numbers is None else numbers[n], frame.time)
        pad = (0, frame.rgb.shape[3] - width, 0, frame.rgb.shape[2] - height)
        rgb.append(torch.nn.functional.pad(_image(image, cover, behind, imperfections, seeds), pad))
        mask.append(torch.nn.functional.pad(_mask(cover, imperfections, seeds), pad))
    return replace(frame, rgb=torch.stack(rgb), mask=torch.stack(mask))


def imperfect_masks(
    masks: UInt8[Tensor, "view height width"],
    imperfections: Imperfections,
    seed: int,
    time: int,
    numbers: Sequence[int],
) -> UInt8[Tensor, "view height width"]:
    """Compute the masks of `imperfect_frame` alone; `numbers` are the cameras' positions in the rig."""
    if imperfections == Imperfections():
        return masks
    pairs = zip(masks, numbers, strict=True)
    return torch.stack([_mask(mask, imperfections, (seed, number, time)) for mask, number in pairs])


def _image(rgb: Picture, mask: Mask, background: Backdrop | None, it: Imperfections, seeds: Seeds) -> Picture:
    """Apply spill, then exposure and white balance in linear light, noise and compression.

    Gains and strengths of noise are looked up by 8-bit level: powers for every pixel would cost as
    much as drawing.
    """
    seed, view, time = seeds
    if it.spill and background is not None:
        rgb = _add_spill(rgb, mask, background, it.spill)
    level = (torch.arange(256, device=rgb.device) / 255).expand(3, -1)
    if it.exposure_stops or it.white_balance:
        draw = torch.randn(4, generator=_generator(seed, 2, view, 0)).to(level)
        gain = torch.exp2(it.exposure_stops * draw[3]) * (1 + it.white_balance * draw[:3])
        level = srgb_from_linear(linear_from_srgb(level) * gain[:, None])
    entry = rgb.long() + 256 * torch.arange(3, device=rgb.device)[:, None, None]
    if it.shot_noise or it.read_noise:
        strength = (it.read_noise**2 + it.shot_noise**2 * level).sqrt()
        noise = torch.randn(rgb.shape, generator=_generator(seed, 3, view, time)).to(level)
        value = torch.addcmul(level.take(entry), noise, strength.take(entry))
        out = (value.clamp_(0, 1) * 255).round().to(torch.uint8)
    else:
        out = (level * 255).round().to(torch.uint8).take(entry)
    if it.jpeg_quality is None:
        return out
    pixels = np.ascontiguousarray(out.permute(1, 2, 0).cpu().numpy()[..., ::-1])
    encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, it.jpeg_quality])[1]
    decoded = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    assert decoded is not None, "what was just encoded decodes"
    return (
        torch.from_numpy(np.ascontiguousarray(decoded[..., ::-1]))
        .permute(2, 0, 1)
        .contiguous()
        .to(rgb.device)
    )


def _add_spill(rgb: Picture, mask: Mask, background: Backdrop, strength: float) -> Picture:
    """Add the background's colour to the subject, more strongly near its outline."""
    window = _window(mask, SPILL_PX)
    inside = _blur(mask[window].float() / 255, SPILL_PX)
    share = strength * 2 * (1 - inside).clamp(0, 0.5) * (mask[window] > 0)
    # Further than the blur reaches nothing is stained; its tails are below a level.
    near = share > strength / 500
    out = rgb.clone()
    part = out[:, *window]
    linear = linear_from_srgb(part[:, near].float() / 255)
    mixed = torch.lerp(linear, background[:, *window][:, near], share[near])
    part[:, near] = (srgb_from_linear(mixed) * 255).round().to(torch.uint8)
    return out


def _window(mask: Tensor, sigma_px: float) -> tuple[slice, slice]:
    """Rows and columns that contain a mask, and a margin around it as wide as a blur."""
    bounds = []
    margin = _blur_radius_px(sigma_px)
    for along in (1, 0):
        places = (mask > 0).any(along).nonzero().flatten().tolist() or [0]
        bounds.append(slice(max(0, places[0] - margin), places[-1] + 1 + margin))
    return bounds[0], bounds[1]


def _mask(mask: Mask, it: Imperfections, seeds: Seeds) -> Mask:
    """Add holes and blobs to a mask, then let its outline wander and soften."""
    seed, view, time = seeds
    generator = _generator(seed, 4, view, time)
    value = mask.float() / 255
    if it.mask_holes or it.mask_blobs:
        means = torch.tensor([it.mask_holes, it.mask_blobs])
        holes, blobs = torch.poisson(means, generator=generator).int().tolist()
        # Holes lie in the subject, blobs anywhere: a hole that misses it would change nothing.
        for where, count, to in ((value > 0.5, holes, 0.0), (value < 2, blobs, 1.0)):
            for _ in range(count):
                value = torch.where(_spot(where, generator), torch.full_like(value, to), value)
    if it.mask_edge_px:
        sigma = 1.5 * it.mask_edge_px
        window = _window(value, sigma)
        part = value[window]
        coarse = torch.randn(1, 1, 8, 8, generator=generator).to(value)
        wander = torch.nn.functional.interpolate(coarse, size=tuple(part.shape), mode="bicubic")[0, 0]
        lean = torch.randn((), generator=_generator(seed, 5, view, 0)).to(value)
        # A blurred straight edge has the slope 0.4 / sigma: this moves its half level by about mask_edge_px.
        shift = 0.4 * it.mask_edge_px / sigma * (0.7 * wander + 0.7 * lean)
        # Bounded so that, with this gain, what is flat stays flat: 2.5 (0.5 - 0.3) = 0.5.
        shift = 0.3 * torch.tanh(shift / 0.3)
        value = value.clone()
        value[window] = (2.5 * (_blur(part, sigma) - 0.5 + shift) + 0.5).clamp(0, 1)
    if it.mask_hard:
        value = (value > 0.5).to(value)
    return (value * 255).round().to(torch.uint8)


def _spot(where: Tensor, generator: torch.Generator) -> Tensor:
    """Draw an ellipse around a random pixel of `where`, 1 to 4 per cent of the image across."""
    height, width = where.shape
    places = where.nonzero()
    draw = torch.rand(4, generator=generator).tolist()
    if not len(places):
        return torch.zeros_like(where)
    row, column = places[int(draw[0] * len(places))].tolist()
    radii = [max(height, width) * (0.005 + 0.015 * d) for d in draw[1:3]]
    y = (torch.arange(height, device=where.device) - row)[:, None]
    x = (torch.arange(width, device=where.device) - column)[None]
    return (y / radii[0]) ** 2 + (x / radii[1] + (draw[3] - 0.5) * y / radii[0]) ** 2 < 1


def _blur_radius_px(sigma_px: float) -> int:
    """Radius of a blur's kernel, pixels."""
    return max(1, round(3 * sigma_px))


def _blur(value: Float[Tensor, "height width"], sigma_px: float) -> Float[Tensor, "height width"]:
    """Gaussian blur; the outermost pixels continue beyond the image."""
    reach = _blur_radius_px(sigma_px)
    offsets = torch.arange(-reach, reach + 1, device=value.device)
    kernel = torch.exp(-0.5 * (offsets / sigma_px) ** 2)
    kernel = kernel / kernel.sum()
    padded = torch.nn.functional.pad(value[None, None], (reach,) * 4, mode="replicate")
    rows = torch.nn.functional.conv2d(padded, kernel[None, None, :, None])
    return torch.nn.functional.conv2d(rows, kernel[None, None, None, :])[0, 0]


def _generator(*key: int) -> torch.Generator:
    """Random numbers that depend on the key alone: capture seed, purpose, camera, time."""
    return torch.Generator().manual_seed(
        int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> 1)
    )
