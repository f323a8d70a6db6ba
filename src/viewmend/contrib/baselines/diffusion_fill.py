"""Stable Diffusion 2 inpainting as RGVI's reference frame, through `diffusers`, from a folder that the user has."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate

from viewmend.metrics.weights import weight_folders

FOLDERS = ("stable-diffusion-2-inpainting", "sd2-inpainting")
"""Names of the folder, in one of the places where weights are looked for."""
PROMPT = "Empty background, high resolution"
"""RGVI's own; on subjects that were cut out it fills with background now and then, as the paper notes."""
SEED = 2024
CELL_PX, MOST_PX = 8, 768


class DiffusionFill:
    """A fill of whatever nothing else is known about."""

    def __init__(self, folder: Path, device: torch.device | str = "cpu") -> None:
        self.folder = folder
        self._device = torch.device(device)
        self._pipeline: Any = None

    def __call__(
        self,
        image: Float[Tensor, "3 height width"],
        missing: Bool[Tensor, "height width"],
        subject: Bool[Tensor, "height width"],
    ) -> Float[Tensor, "3 height width"]:
        """The image with its missing pixels filled; all others stay."""
        height, width = missing.shape
        scale = min(1.0, MOST_PX / max(height, width))
        rows, columns = (max(CELL_PX, round(s * scale / CELL_PX) * CELL_PX) for s in (height, width))
        shown = interpolate(image[None], (rows, columns), mode="bilinear", antialias=True)[0].clamp(0, 1)
        holes = interpolate(missing[None, None].float(), (rows, columns), mode="area")[0] > 0
        painted = self._loaded()(
            prompt=PROMPT,
            image=shown[None],
            mask_image=holes[None].float(),
            height=rows,
            width=columns,
            generator=torch.Generator().manual_seed(SEED),
            output_type="np",
        ).images[0]
        found = torch.from_numpy(np.ascontiguousarray(painted)).movedim(-1, 0)[None].to(image)
        filled = interpolate(found, (height, width), mode="bilinear")[0].clamp(0, 1)
        return torch.where(missing, filled, image)

    def _loaded(self) -> Any:
        if self._pipeline is None:
            from diffusers import StableDiffusionInpaintPipeline  # pyright: ignore[reportMissingImports]

            dtype = torch.float16 if self._device.type == "cuda" else torch.float32
            self._pipeline = StableDiffusionInpaintPipeline.from_pretrained(
                self.folder, torch_dtype=dtype, use_safetensors=True, local_files_only=True, safety_checker=None
            ).to(self._device)
        return self._pipeline


def find_diffusion(device: torch.device | str = "cpu") -> DiffusionFill | None:
    """The fill, if `diffusers` is installed and a folder of its weights is where weights are looked for."""
    from importlib.util import find_spec

    folders = (place / name for place in weight_folders() for name in FOLDERS)
    folder = next((folder for folder in folders if (folder / "model_index.json").is_file()), None)
    return None if folder is None or find_spec("diffusers") is None else DiffusionFill(folder, device)
