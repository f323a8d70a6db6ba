"""A glTF character animated by a BVH motion, on the studio's stage."""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.data.errors import CaptureError
from viewmend.geometry.rigid import rotation_from_axis_angle
from viewmend.studio.bvh import Motion, read_bvh
from viewmend.studio.gltf import load_character
from viewmend.studio.performer import TexturedMesh
from viewmend.studio.retarget import Retarget, retarget

ROAM_M = 0.7
"""Largest distance of the slow part of a path from the stage's centre, metres."""
SLOW_S = 0.8
"""Standard deviation of the Gaussian that splits a path into a slow and a fast part."""
CUT = 7.0
"""The Gaussian ends at this many standard deviations, where it is below 1e-10 of its peak."""
FLOOR_SAMPLES = 16
FLIGHT_M = 0.03
"""Soles this many metres above their lowest few per cent are in flight, not on the floor."""


class GltfPerformer:
    """One character with one motion: implements `Performer`.

    The clip starts at a seeded moment such that `duration_s` fits if the clip is long enough, and
    turned by a seeded angle; past its end it runs backwards, so that no pose jumps. Where the path
    leads away from the stage's centre by more than about `ROAM_M`, the stage moves along with its
    slow part, like a treadmill. The floor is found once per clip: the lowest vertex stands on it in
    the median frame, or slightly above in clips with jumps.
    """

    def __init__(
        self,
        character: Path,
        motion: Path,
        seed: int = 0,
        duration_s: float = 2.0,
        cloth_variety: float = 0.0,
    ) -> None:
        """Load both files; `cloth_variety` is the fraction of the character's garments that the seed changes.

        Raises:
            CaptureError: a file is unreadable, or its skeleton is not a human one.
            ValueError: `cloth_variety` is not in [0, 1].
        """
        self.motion = read_bvh(motion)
        self.character = load_character(character)
        try:
            self._body: Retarget = retarget(self.character, self.motion)
        except ValueError as error:
            raise CaptureError(f"{character} with {motion}: {error}") from error
        if cloth_variety != 0:
            from viewmend.studio.garments import vary_cloth

            self.character = vary_cloth(self.character, self._body.upright_from_file, cloth_variety, seed)
        self.description = f"{character.stem} doing {motion.stem}"
        chance, turn = torch.rand(2, generator=torch.Generator().manual_seed(seed)).tolist()
        self._start_s = chance * max(0.0, self.motion.duration_s - duration_s)
        self._stage_from_motion = rotation_from_axis_angle(torch.tensor([0.0, turn * 2 * math.pi, 0.0]))
        middle = min(self._start_s + duration_s / 2, self.motion.duration_s)
        self._shift = _stage_shift(self._body.hips_path, self.motion, middle)
        self._shift[:, 1] = -self._floor()

    def pose(self, time_s: float) -> TexturedMesh:
        """The performer `time_s` after the start of its window."""
        frame = self._frame(self._start_s + time_s)
        before = min(int(frame), len(self._shift) - 1)
        after = min(before + 1, len(self._shift) - 1)
        matrices = self._body.joint_matrices(frame)
        matrices[:, :3, 3] += torch.lerp(self._shift[before], self._shift[after], frame - before)
        matrices[:, :3] = self._stage_from_motion @ matrices[:, :3]
        return self.character.skin(matrices)

    def _frame(self, clip_s: float) -> float:
        """Frame number at a time of the clip, which plays back and forth."""
        last = len(self.motion.root) - 1
        if last == 0:
            return 0.0
        frame = math.fmod(abs(clip_s) / self.motion.seconds_per_frame, 2 * last)
        frame = 2 * last - frame if frame > last else frame
        # Times are products of 1/fps: without this, frame 3 would be 2.9999998 of the way to it.
        return float(round(frame)) if abs(frame - round(frame)) < 1e-3 else frame

    def _floor(self) -> float:
        """Height of the floor under the clip: the median of the soles, or their 5th percentile and a little."""
        count = len(self.motion.root)
        lows = []
        for n in range(min(FLOOR_SAMPLES, count)):
            matrices = self._body.joint_matrices(float(n * count // min(FLOOR_SAMPLES, count)))
            lows.append(self.character.skin(matrices).mesh.vertices[:, 1].min())
        heights = torch.stack(lows)
        return float(torch.minimum(heights.quantile(0.5), heights.quantile(0.05) + FLIGHT_M))


def _smooth(path: Float[Tensor, "frame 3"], sigma: float) -> Float[Tensor, "frame 3"]:
    """The Gaussian mean around each frame, of the frames that exist; `sigma` in frames."""
    from scipy.ndimage import gaussian_filter1d

    def blur(values: np.ndarray) -> np.ndarray:
        return gaussian_filter1d(values, sigma, axis=0, mode="constant", truncate=CUT)

    weights = blur(np.ones((len(path), 1)))
    return torch.from_numpy(blur(path.double().numpy()) / weights).float()


def _stage_shift(path: Float[Tensor, "frame 3"], motion: Motion, middle_s: float) -> Float[Tensor, "frame 3"]:
    """Compute the offset of each frame that keeps a path near the stage's centre; y is 0.

    The slow part of the path, seen from where it is at `middle_s`, is squeezed into a disc of `ROAM_M`.
    """
    flat = path * torch.tensor([1.0, 0.0, 1.0])
    slow = _smooth(flat, SLOW_S / motion.seconds_per_frame)
    from_middle = slow - slow[min(round(middle_s / motion.seconds_per_frame), len(slow) - 1)]
    distance = from_middle.norm(dim=1, keepdim=True).clamp(min=1e-6)
    squeezed = from_middle / distance * ROAM_M * torch.tanh(distance / ROAM_M)
    return squeezed - slow
