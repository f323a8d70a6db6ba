"""What travels between the rooms: frames in, incomplete views, completed views out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras

RIM_PX = 2
"""How far beyond the proxy the subject may be: silhouettes and grids cut off that much."""


@dataclass(frozen=True)
class MultiViewFrame:
    """What all cameras of a rig saw at one time: I[i,t] and M[i,t] of section 1.

    Images are 8 bit, as cameras deliver them, undistorted, and padded with zeros right and below to the largest;
    `cameras.size_px` says what is image. A camera without a frame at this time is absent.

    Examples:
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> frame.rgb.shape, frame.time
        (torch.Size([4, 3, 64, 64]), 0)
        >>> len(frame.without(frame.cameras.names[:1]).cameras)
        3
    """

    cameras: Cameras
    rgb: UInt8[Tensor, "view 3 height width"]
    mask: UInt8[Tensor, "view height width"] | None
    """Foreground, 0 to 255, in between soft; None for a capture without masks."""
    time: int
    """Index of the frame in its capture or stream; grows by one a frame."""
    depth: Float[Tensor, "view height width"] | None = None
    """True z-depth in metres where it is known (synthetic captures), 0 where there is no surface."""

    def select(self, names: Sequence[str]) -> "MultiViewFrame":
        """The same time seen by these cameras alone, in this order; ValueError for an unknown name."""
        if tuple(names) == self.cameras.names:
            return self
        cameras = self.cameras.select(names)
        index = torch.tensor([self.cameras.names.index(n) for n in names], device=self.rgb.device, dtype=torch.long)
        # Drop the padding that only the others needed: a stack is as large as its largest image.
        width, height = cameras.max_size_px if names else (self.rgb.shape[-1], self.rgb.shape[-2])
        return replace(
            self,
            cameras=cameras,
            rgb=_chosen(self.rgb, index, height, width),
            mask=None if self.mask is None else _chosen(self.mask, index, height, width),
            depth=None if self.depth is None else _chosen(self.depth, index, height, width),
        )

    def without(self, names: Sequence[str]) -> "MultiViewFrame":
        """The same time without these cameras (absent ones are no error)."""
        return self.select([n for n in self.cameras.names if n not in names])

    def to(self, device: torch.device | str) -> "MultiViewFrame":
        """The same frame on `device`."""
        return replace(
            self,
            cameras=self.cameras.to(device),
            rgb=self.rgb.to(device),
            mask=None if self.mask is None else self.mask.to(device),
            depth=None if self.depth is None else self.depth.to(device),
        )


def _chosen(images: Tensor, index: Int[Tensor, "view"], height: int, width: int) -> Tensor:
    """Some of a stack of images, cut to this size; in a tenth of the time that indexing in all axes takes."""
    return images[..., :height, :width].index_select(0, index)


@dataclass(frozen=True)
class WindowPart:
    """What must be known of the whole images where images are parts of them; training learns from such parts."""

    whole_size_px: tuple[int, int]
    """Width and height of the whole, of the first image of several."""
    reference_m: Float[Tensor, "view"]
    """Median depth of each whole image, metres."""
    inner: Bool[Tensor, "view height width"]
    """Only patches within count; what is around them is there for the encoder."""

    def select(self, index: Int[Tensor, "view"], height: int, width: int) -> "WindowPart":
        """The parts of some images, cut to this size."""
        return replace(self, reference_m=self.reference_m[index], inner=self.inner[index, :height, :width])


@dataclass(frozen=True)
class ContextViews:
    """Camera images of one time with the geometry proxy's depth in them: all that an inpainter sees of a rig.

    Examples:
        >>> from viewmend import Stream, make_method
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> seen = Stream(make_method("telea")).push(frame).context(frame.cameras.names[:2])
        >>> seen.depth.shape
        torch.Size([2, 64, 64])
    """

    frame: MultiViewFrame
    depth: Float[Tensor, "view height width"]
    """z-depth of G[t] in each camera, metres; 0 where the proxy is not seen."""
    part: WindowPart | None = None
    """Where each image is a part of a camera's own."""

    def to(self, device: torch.device | str) -> "ContextViews":
        """The same on `device`."""
        return replace(self, frame=self.frame.to(device), depth=self.depth.to(device))

    def select(self, names: Sequence[str]) -> "ContextViews":
        """What those of these cameras that are there saw, in the order of `names`."""
        own = self.frame.cameras.names
        frame = self.frame.select([n for n in names if n in own])
        index = torch.tensor([own.index(n) for n in frame.cameras.names], device=self.depth.device, dtype=torch.long)
        height, width = frame.rgb.shape[2:]
        part = None if self.part is None else self.part.select(index, height, width)
        return ContextViews(frame, _chosen(self.depth, index, height, width), part)


@dataclass(frozen=True)
class Silhouettes:
    """The masks of a rig at one time, without its images.

    Examples:
        >>> from viewmend import Silhouettes
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> Silhouettes(frame.mask, frame.cameras).mask.dtype
        torch.uint8
    """

    mask: UInt8[Tensor, "view height width"]
    """Foreground, 0 to 255."""
    cameras: Cameras

    def select(self, names: Sequence[str]) -> "Silhouettes":
        """The masks of these cameras, in this order; ValueError for an unknown name."""
        index = [self.cameras.names.index(name) for name in names]
        return Silhouettes(self.mask[index], self.cameras.select(names))

    def to(self, device: torch.device | str) -> "Silhouettes":
        """The same on `device`."""
        return Silhouettes(self.mask.to(device), self.cameras.to(device))


@dataclass(frozen=True)
class IncompleteView:
    """A rendered novel view and what is missing in it: F[t], M[t], E[t] of section 1.

    Examples:
        >>> import torch
        >>> from viewmend import IncompleteView, pinhole
        >>> camera = pinhole(0.8, 64, 48, torch.eye(4))
        >>> rgb, ones, weights = torch.zeros(3, 48, 64), torch.ones(48, 64), torch.zeros(1, 48, 64)
        >>> view = IncompleteView(camera, rgb, ones, ones, 2 * ones, source_views=("left",), weights=weights, time=0)
        >>> int((view.error > 0).sum())
        3072
    """

    camera: Cameras
    """The novel view's camera (one view)."""
    rgb: Float[Tensor, "3 height width"]
    """F, in [0, 1]; black where no camera colours it and where there is no subject."""
    mask: Float[Tensor, "height width"]
    """M, in [0, 1]: 1 where the geometry proxy covers the pixel."""
    error: Float[Tensor, "height width"]
    """E, in [0, 1]: 1 where the pixel must be inpainted, 0 where F is right. By some rules F has a colour there, a
    wrong one perhaps."""
    depth: Float[Tensor, "height width"]
    """z-depth of the proxy, metres; 0 where there is none."""
    source_views: tuple[str, ...]
    """Names of the cameras that coloured the view."""
    weights: Float[Tensor, "source height width"]
    """Weight of each source view in each pixel; the sum is 1 where a pixel is coloured, else 0."""
    time: int
    candidate_views: tuple[str, ...] = ()
    """Names of all cameras that an inpainter may look at, the closest first; () where the renderer does not say."""
    silhouettes: Silhouettes | None = None
    """The masks of these cameras at the view's time: they say more exactly than the proxy whether a pixel shows the
    subject at all. None where the renderer does not say."""
    fade: Float[Tensor, "height width"] | None = None
    """How much of a pixel with E > 0 is known to be background, in [0, 1]: it only fades by that, nobody need look. 0
    where a pixel must be looked at. None where nobody knows."""
    part: WindowPart | None = None
    """Where the view is a part of a larger one."""

    @property
    def read(self) -> Bool[Tensor, "height width"]:
        """Pixels that must be looked at: those of E that do not only fade."""
        return self.error > 0 if self.fade is None else (self.error > 0) & (self.fade == 0)

    @property
    def holes(self) -> Bool[Tensor, "height width"]:
        """Pixels of the proxy that no source view colours: the paper's E, whatever the error rule."""
        return (self.mask > 0) & ~(self.weights.sum(0) > 0)  # a seventh of what `any` along an axis takes

    def closest_views(self, count: int) -> tuple[str, ...]:
        """Names of this many cameras: the source views, then the closest others."""
        return tuple(dict.fromkeys((*self.source_views, *self.candidate_views)))[:count]

    def demand_cameras(self, known: Sequence[str]) -> None:
        """ValueError where the view names cameras that are not among these."""
        unknown = sorted({*self.source_views, *self.candidate_views} - set(known))
        if unknown:
            raise ValueError(
                f"expected a view of cameras among {list(known)}, got {unknown}; correct source_views and "
                "candidate_views"
            )


FAINT = 1 / 16
"""Opacity below which a pixel's own colour, divided by it, would be noise."""
NEAR_PX = 4
"""How far a faint pixel looks for colours."""


@dataclass(frozen=True)
class CompletedView:
    """A novel view without holes: Fhat = E * Ftilde + (1 - E) * F (section 1).

    Examples:
        >>> import torch
        >>> from viewmend import Stream, look_at, make_method, pinhole
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> up, subject = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.95, 0.0])
        >>> target = pinhole(0.8, 64, 64, look_at(torch.tensor([0.5, 1.0, 3.0]), subject, up))
        >>> stream = Stream(make_method("telea"))
        >>> completed = stream.view(target, time=stream.push(frame).frame.time).completed
        >>> right = completed.view.error == 0
        >>> torch.equal(completed.rgb[:, right], completed.view.rgb[:, right])
        True
    """

    view: IncompleteView
    rgb: Float[Tensor, "3 height width"]
    """Fhat, in [0, 1], upon black; equal to `view.rgb` bit for bit where E is 0."""
    alpha: Float[Tensor, "height width"] | None = None
    """How much of each pixel the subject covers, in [0, 1]: `rgb` is multiplied by it. None from an inpainter that
    does not tell, whose subject is M."""
    confidence: Float[Tensor, "height width"] | None = None
    """How sure the inpainter is of each pixel, in [0, 1]; 0 where there is no subject. None where it does not tell."""
    depth: Float[Tensor, "height width"] | None = None
    """Refined z-depth of the subject, metres, 0 where there is none. None where the proxy's is all there is."""

    def demand_finite(self, by: str) -> None:
        """See that all that was mended is a finite number.

        Raises:
            ValueError: something is not.
        """
        images = (self.rgb, self.alpha, self.confidence, self.depth)
        if not all(bool(image.isfinite().all()) for image in images if image is not None):
            raise ValueError(f"expected finite colours from {by}, got others; take another model, or train it again")

    @property
    def opacity(self) -> Float[Tensor, "height width"]:
        """`alpha`, or M where the inpainter does not tell."""
        return self.view.mask if self.alpha is None else self.alpha

    @property
    def surface_depth(self) -> Float[Tensor, "height width"]:
        """`depth`, or the proxy's where the inpainter does not tell; metres, 0 where there is no subject."""
        return self.view.depth if self.depth is None else self.depth

    @property
    def straight_rgb(self) -> Float[Tensor, "3 height width"]:
        """Fhat divided by `opacity`, in [0, 1]: colours without the black that they lie upon.

        Where there is next to no opacity it is the colour of what is near, so that nothing dark bleeds in when the
        picture is scaled or compressed; black far from the subject. `rgb + (1 - opacity) * background` lays the view
        over another background.
        """
        opacity = self.opacity[None]
        near = F.avg_pool2d(torch.cat([self.rgb, opacity])[None], 2 * NEAR_PX + 1, 1, NEAR_PX)[0]
        tiny = torch.finfo(near.dtype).tiny
        spread, own = near[:3] / near[3:].clamp(min=tiny), self.rgb / opacity.clamp(min=FAINT)
        return torch.where(opacity < FAINT, spread, own).clamp(0, 1)

    @property
    def images(self) -> dict[str, Float[Tensor, "*channel height width"]]:
        """All images that are there, by the names of their fields."""
        found = {name: getattr(self, name) for name in ("rgb", "alpha", "confidence", "depth")}
        return {name: image for name, image in found.items() if image is not None}
