"""Inputs and outputs of an exported model: the tensors of one view and one frame, by name."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.models.base import ContextProvider
from viewmend.types import IncompleteView


class ViewInputs(NamedTuple):
    """A rendered view, the rig, and the choice of source cameras: the exported model's inputs, in this order.

    Conventions are those of the project (docs/conventions.md): OpenCV axes, metres, pixel centres at +0.5.
    """

    rgb: Float[Tensor, "3 height width"]
    """F, in [0, 1], on black; black where no camera colours the view."""
    mask: Float[Tensor, "height width"]
    """M, in [0, 1]: 1 where the proxy covers the pixel."""
    error: Float[Tensor, "height width"]
    """E, in [0, 1]: 1 where the pixel may change; for the whole subject, M and a rim of two pixels."""
    depth: Float[Tensor, "height width"]
    """z-depth of the proxy, metres; 0 where there is none."""
    weights: Float[Tensor, "chosen height width"]
    """Weight of each chosen camera in each pixel's colour: the sum is 1 where a pixel is coloured, else 0."""
    K: Float[Tensor, "3 3"]
    """The view's intrinsics, pixels."""
    camera_from_world: Float[Tensor, "4 4"]
    """The view's pose."""
    chosen: Int[Tensor, "chosen"]
    """Indices of the source cameras: those that coloured the view, then the closest others."""
    is_source: Bool[Tensor, "chosen"]
    """Whether each of them coloured the view."""
    images: UInt8[Tensor, "camera 3 rows columns"]
    """RGB of all cameras; of those that are not chosen, anything."""
    masks: UInt8[Tensor, "camera rows columns"]
    """Foreground masks of all cameras, 0 to 255."""
    proxy_depths: Float[Tensor, "camera rows columns"]
    """z-depth of the proxy in all cameras, metres, 0 where there is none; of cameras that are not chosen, anything."""
    rig_K: Float[Tensor, "camera 3 3"]  # noqa: N815
    """The cameras' intrinsics, pixels."""
    rig_camera_from_world: Float[Tensor, "camera 4 4"]
    """The cameras' poses."""
    image_sizes_px: Int[Tensor, "camera 2"]
    """Width and height of each camera's image; smaller ones are padded right and below."""
    alpha_slope: Float[Tensor, ""]
    """Factor on the logits of alpha: 1, or that of an inpainter calibrated to the rig."""

    @classmethod
    def of(
        cls, view: IncompleteView, context: ContextProvider, num_views: int, alpha_slope: float = 1.0
    ) -> "ViewInputs":
        """The inputs for a view as `ViewSynthNet.step` would complete it.

        Args:
            view: the rendered view.
            context: the cameras' images.
            num_views: number of source cameras.
            alpha_slope: of the inpainter calibrated to the rig.

        Raises:
            ValueError: fewer than two of the cameras that the view names have a frame.
        """
        wanted = view.closest_views(num_views)
        rig = wanted if view.silhouettes is None else view.silhouettes.cameras.names
        seen = context(view.time, tuple(dict.fromkeys((*rig, *wanted))))
        names = () if seen is None else seen.frame.cameras.names
        chosen = [name for name in wanted if name in names]
        if seen is None or len(chosen) < 2:
            raise ValueError(
                f"expected a view that names at least two cameras with a frame, got {chosen}; give source_views and "
                "candidate_views"
            )
        frame, weights = seen.frame, dict(zip(view.source_views, view.weights, strict=True))
        return cls(
            *(view.rgb, view.mask, view.error, view.depth),
            weights=torch.stack([weights.get(name, torch.zeros_like(view.mask)) for name in chosen]),
            K=view.camera.K[0],
            camera_from_world=view.camera.camera_from_world[0],
            chosen=torch.tensor([names.index(name) for name in chosen]),
            is_source=torch.tensor([name in view.source_views for name in chosen]),
            images=frame.rgb,
            masks=(255 * (seen.depth > 0)).to(torch.uint8) if frame.mask is None else frame.mask,
            proxy_depths=seen.depth,
            rig_K=frame.cameras.K,
            rig_camera_from_world=frame.cameras.camera_from_world,
            image_sizes_px=frame.cameras.size_px.long(),
            alpha_slope=torch.tensor(alpha_slope),
        )

    @property
    def view(self) -> IncompleteView:
        """The rendered view; its cameras have no names here."""
        size = torch.tensor([[self.mask.shape[1], self.mask.shape[0]]])
        camera = Cameras(("view",), self.K[None], self.camera_from_world[None], size)
        return IncompleteView(camera, self.rgb, self.mask, self.error, self.depth, (), self.weights, 0)


class ViewOutputs(NamedTuple):
    """The completed view: the exported model's outputs, in this order. Where E is 0, the view is unchanged."""

    mended_rgb: Float[Tensor, "3 height width"]
    """Fhat, in [0, 1], on black."""
    alpha: Float[Tensor, "height width"]
    """Fraction of each pixel that the subject covers, in [0, 1]."""
    confidence: Float[Tensor, "height width"]
    """Probability that the pixel is correct, in [0, 1]."""
    mended_depth: Float[Tensor, "height width"]
    """z-depth of the subject, metres; 0 where there is none."""
