"""The data that the stages of the pipeline exchange.

    MultiViewFrame   what the cameras of a rig captured in one frame
    ContextViews     some of these cameras, with the geometry proxy's depth: what an inpainter samples
    IncompleteView   a rendered novel view with its error mask: what an inpainter completes
    CompletedView    the completed view, with alpha, confidence and depth where the model predicts them

All are frozen. Images are tensors of shape (channel, height, width) or (height, width); colours are
RGB. Novel views are in [0, 1] and on black, that is, multiplied by alpha. Camera axes are OpenCV's,
pixel centres are at +0.5, lengths are in metres. The symbols I, M, F, E and G, and the section
numbers, are those of the paper.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, check_names, concatenate_cameras
from viewmend.geometry.hull import FOREGROUND
from viewmend.geometry.rim import rim_depth
from viewmend.utils.tensors import OnDevice, check_tensor, extremes

FAINT = 1 / 16
"""A pixel's colour divided by its opacity is noise if the opacity is below this."""
NEAR_PX = 4
"""Faint pixels take the mean colour of their neighbours up to this many pixels away."""
OVERSHOOT = 0.4
"""Images in [0, 1] may leave this range by this much, as those of renderers and networks do."""
SUM_TOLERANCE = 1e-2
"""Each pixel's weights have a sum s of 0 or 1; s (1 - s) may differ from 0 by this much."""
NOISE = 0.01
"""Masks of values 0 and 1 (of 255) show no subject, but a matting's noise, if at most this fraction
of the pixels is 1; if more are, they were probably made with values from 0 to 1."""
TO_FLOAT = "convert it with .float(), and divide 8-bit images by 255"
"""Messages about images of another type than float32 suggest this."""


class _LazyStacks:
    """Image fields that are given camera by camera, and stacked into one tensor when they are first read.

    Selecting cameras this way copies nothing: a view that needs a few pixels of each camera need
    not pay for the rest.
    """

    _parts: dict[str, Sequence[Tensor]]

    @classmethod
    def _of_parts(cls, parts: Mapping[str, Sequence[Tensor]], **fields: Any) -> Any:
        """An instance with these fields, of which those in `parts` are not stacked yet."""
        made = object.__new__(cls)
        vars(made).update(fields, _parts=dict(parts))
        return made

    def per_camera(self, field: str) -> Sequence[Tensor]:
        """The images of a field, one per camera, without copying; empty if the field is None."""
        if field not in vars(self):
            return vars(self)["_parts"][field]
        images = vars(self)[field]
        return () if images is None else images.unbind()

    def __getstate__(self) -> dict[str, Any]:
        """The fields, stacked: what is pickled."""
        # pyrefly: ignore[bad-argument-type]
        return {field.name: getattr(self, field.name) for field in fields(self)}

    if not TYPE_CHECKING:  # to a type checker, all fields are attributes

        def __getattr__(self, name: str) -> Tensor:
            """The stack of a field that is read for the first time."""
            if name not in vars(self).get("_parts", {}):
                raise AttributeError(f"{type(self).__name__} has no attribute {name}")
            vars(self)[name] = torch.stack(tuple(self._parts[name]))
            return vars(self)[name]


@dataclass(frozen=True)
class MultiViewFrame(_LazyStacks, OnDevice):
    """The images of all cameras of a rig in one frame: I[i,t] and M[i,t] of section 1.

    Images are undistorted, 8 bit, and padded with zeros at the right and bottom to the largest one;
    `cameras.size_px` has the size of each. A camera without an image in this frame is absent.

    Examples:
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> frame.rgb.shape, frame.time, len(frame.without(frame.cameras.names[:1]).cameras)
        (torch.Size([4, 3, 64, 64]), 0, 3)
    """

    cameras: Cameras
    rgb: UInt8[Tensor, "view 3 height width"]
    mask: UInt8[Tensor, "view height width"] | None
    """Foreground, 0 to 255, soft in between; None for a capture without masks."""
    time: int
    """Index of the frame in its capture or stream."""
    depth: Float[Tensor, "view height width"] | None = None
    """Ground-truth z-depth in metres, if known (synthetic captures); 0 where there is no surface."""

    @property
    def has_subject(self) -> bool:
        """Whether any mask has foreground; False without masks."""
        return any(bool((mask > FOREGROUND).any()) for mask in self.per_camera("mask"))

    def select(self, names: Sequence[str]) -> "MultiViewFrame":
        """The same frame with only these cameras, in this order; ValueError for an unknown name or a string.

        Images and masks are copied only when they are read; ground-truth depth at once.
        """
        check_names("names", names)
        if tuple(names) == self.cameras.names:
            return self
        cameras = self.cameras.select(names)
        index = [self.cameras.names.index(name) for name in names]
        if not names:
            mask = None if self.mask is None else self.mask[:0]
            depth = None if self.depth is None else self.depth[:0]
            return replace(self, cameras=cameras, rgb=self.rgb[:0], mask=mask, depth=depth)
        width, height = cameras.max_size_px  # a stack is as large as its largest image

        def selected(field: str) -> list[Tensor]:
            """The images of a field, cut to their largest size; empty if the field is None."""
            images = self.per_camera(field)
            return [images[i][..., :height, :width] for i in index] if len(images) else []

        own: dict[str, Any] = {"cameras": cameras, "time": self.time, "mask": None, "depth": None}
        parts = {"rgb": selected("rgb")}
        masks = selected("mask")
        if masks:
            parts["mask"] = masks
            del own["mask"]  # stacked when it is read
        depths = selected("depth")
        if depths:
            own["depth"] = torch.stack(depths)
        return MultiViewFrame._of_parts(parts, **own)

    def check(self) -> None:
        """ValueError if a field does not have the type and shape stated above, or if masks are 0 and 1.

        Masks, or images if there are none, may not have content beyond the cameras' size_px.
        """
        if isinstance(self.time, bool) or not isinstance(self.time, int | np.integer):
            raise ValueError(
                f"expected time as a whole number, the frame's index, got {self.time!r}; count the frames"
            )
        self.cameras.check()
        width, height = self.cameras.max_size_px
        convert = "scale it to 0 to 255, and convert it with .byte()"
        arrange = "give one image per camera, channels first, each at least as large as its camera's size_px"
        shape = (len(self.cameras), 3, height, width)
        check_tensor("rgb", self.rgb, (torch.uint8,), shape, convert=convert, arrange=arrange, padded=True)
        if self.mask is not None:
            _check_mask(self.mask, (len(self.cameras), *self.rgb.shape[2:]), (height, width))
        else:
            beyond = sum(int(part.sum()) for part in _padding(self.rgb, (height, width)))
            _check_padding(beyond, self.rgb, (height, width))

    def without(self, names: Sequence[str]) -> "MultiViewFrame":
        """The same frame without these cameras; names that are not in the frame are ignored."""
        check_names("names", names)
        return self.select([n for n in self.cameras.names if n not in names])


@dataclass(frozen=True)
class ContextViews(_LazyStacks, OnDevice):
    """Camera images of one frame, with the geometry proxy's depth in each: everything an inpainter knows about a rig.

    Examples:
        >>> from viewmend import Stream, make_method
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> Stream(make_method("telea")).add_frame(frame).context(frame.cameras.names[:2]).depth.shape
        torch.Size([2, 64, 64])
    """

    frame: MultiViewFrame
    depth: Float[Tensor, "view height width"]
    """z-depth of G[t] in each camera, metres; 0 where the camera does not see the proxy."""

    @classmethod
    def of_depths(
        cls, frame: MultiViewFrame, depths: Sequence[Float[Tensor, "_height _width"]]
    ) -> "ContextViews":
        """A frame with one depth image per camera, at least as large as the frame's images, without copying."""
        height, width = frame.per_camera("rgb")[0].shape[1:]
        return cls._of_parts({"depth": [depth[:height, :width] for depth in depths]}, frame=frame)

    def select(self, names: Sequence[str]) -> "ContextViews":
        """Those of these cameras that are present, in the order of `names`, without copying."""
        own = self.frame.cameras.names
        frame = self.frame.select([name for name in names if name in own])
        if not len(frame.cameras):
            return ContextViews(frame, self.depth[:0])
        depths = self.per_camera("depth")
        return ContextViews.of_depths(frame, [depths[own.index(name)] for name in frame.cameras.names])


@dataclass(frozen=True)
class Silhouettes(OnDevice):
    """The masks of a rig in one frame, without its images.

    Examples:
        >>> import torch
        >>> from viewmend import Cameras, Silhouettes, pinhole
        >>> Silhouettes(torch.zeros(1, 48, 64, dtype=torch.uint8), pinhole(0.8, 64, 48, torch.eye(4))).mask.shape
        torch.Size([1, 48, 64])
    """

    mask: UInt8[Tensor, "view height width"]
    """Foreground, 0 to 255."""
    cameras: Cameras

    def check(self) -> None:
        """ValueError if a field does not have the type and shape stated above, or if masks are 0 and 1."""
        self.cameras.check()
        width, height = self.cameras.max_size_px
        _check_mask(self.mask, (len(self.cameras), height, width), (height, width))

    def select(self, names: Sequence[str]) -> "Silhouettes":
        """The masks of these cameras, in this order; ValueError for an unknown name."""
        index = [self.cameras.names.index(name) for name in names]
        return Silhouettes(self.mask[index], self.cameras.select(names))

    def joined(self, others: "Silhouettes | None") -> "Silhouettes":
        """These masks and those of other cameras, padded to the largest."""
        if others is None:
            return self
        height = max(self.mask.shape[1], others.mask.shape[1])
        width = max(self.mask.shape[2], others.mask.shape[2])
        padded = [F.pad(m, (0, width - m.shape[2], 0, height - m.shape[1])) for m in (self.mask, others.mask)]
        return Silhouettes(torch.cat(padded), concatenate_cameras([self.cameras, others.cameras]))


def _check_mask(mask: object, shape: tuple[int, ...], size: tuple[int, int]) -> None:
    """ValueError unless these are masks of 0 to 255, of this shape or padded; they may be empty.

    They have to be 0 beyond `size`, the height and width of the largest camera.
    """
    convert = "scale it to 0 to 255, and convert it with .byte()"
    arrange = "give one mask per camera, as large as the images"
    masks = check_tensor("mask", mask, (torch.uint8,), shape, convert=convert, arrange=arrange, padded=True)
    padding = [part.sum() for part in _padding(masks, size)]
    # This waits for a GPU only once
    largest, total, *beyond = torch.stack([masks.max().long(), masks.sum(), *padding]).tolist()
    _check_padding(sum(beyond), masks, size)
    if largest == 1 and total > NOISE * masks.numel():
        raise ValueError("expected masks of 0 to 255, got masks of 0 and 1; multiply them by 255")


def _padding(images: Tensor, size: tuple[int, int]) -> list[Tensor]:
    """The parts of a stack of images below and to the right of this height and width, without those of no pixels."""
    height, width = size
    return [part for part in (images[..., height:, :], images[..., width:]) if part.numel()]


def _check_padding(total: int, images: Tensor, size: tuple[int, int]) -> None:
    """ValueError if the sum of the padding of images is not 0: their cameras are those of other images."""
    if total:
        height, width = size
        raise ValueError(
            f"expected zeros beyond the cameras' size_px of at most {width} x {height}, got images of "
            f"{images.shape[-1]} x {images.shape[-2]} with content there; give the K and size_px of images of this "
            "size, or pad with zeros"
        )


@dataclass(frozen=True)
class IncompleteView:
    """A rendered novel view and its error mask: F[t], M[t] and E[t] of section 1.

    Examples:
        >>> import torch
        >>> from viewmend import IncompleteView, pinhole
        >>> camera = pinhole(0.8, 64, 48, torch.eye(4))
        >>> rgb, ones, weights = torch.zeros(3, 48, 64), torch.ones(48, 64), torch.zeros(1, 48, 64)
        >>> view = IncompleteView(camera, rgb, ones, ones, 2 * ones, source_views=("left",), weights=weights, time=0)
        >>> int(view.holes.sum())
        3072
    """

    camera: Cameras
    """The novel view's camera (one view)."""
    rgb: Float[Tensor, "3 height width"]
    """F, in [0, 1]; black where no camera colours the pixel and where there is no subject."""
    mask: Float[Tensor, "height width"]
    """M, in [0, 1]: 1 where the geometry proxy covers the pixel."""
    error: Float[Tensor, "height width"]
    """E, in [0, 1]: 1 where the pixel must be inpainted, 0 where it must not change. With some
    error rules, pixels to inpaint already have a colour, which may be wrong."""
    depth: Float[Tensor, "height width"]
    """z-depth of the proxy, metres; 0 where there is none."""
    source_views: tuple[str, ...]
    """Names of the cameras that coloured the view, the closest first."""
    weights: Float[Tensor, "source height width"]
    """Blend weight of each source view in each pixel; they sum to 1 where a pixel is coloured, else to 0."""
    time: int
    """Index of the frame."""
    candidate_views: tuple[str, ...] = ()
    """Names of all cameras that an inpainter may use, the closest first; () if the renderer does
    not name them."""
    silhouettes: Silhouettes | None = None
    """The masks of these cameras in the same frame, which bound the subject more exactly than the
    proxy; None if the renderer does not provide them."""
    fade: Float[Tensor, "height width"] | None = None
    """Predicted background fraction, in [0, 1], of pixels with E > 0 that are only attenuated; 0
    where a pixel is to be re-synthesised. None: all pixels with E > 0 are."""
    target_mask: Float[Tensor, "height width"] | None = None
    """M_t, the subject's true mask in this view, in [0, 1], where one is known: from a matting of
    the target camera, a better silhouette, or the alpha of another model. It may be smaller than
    the proxy: the completed view shows nothing outside of it. `rgb` is not multiplied by it. None:
    nothing is known beyond the proxy's silhouette."""

    @property
    def silhouette(self) -> Float[Tensor, "height width"]:
        """Alpha of the rendered view: M, cut by `target_mask` if there is one."""
        return self.mask if self.target_mask is None else self.mask * self.target_mask

    @property
    def cut_rgb(self) -> Float[Tensor, "3 height width"]:
        """F, cut by `target_mask` if there is one."""
        return self.rgb if self.target_mask is None else self.rgb * self.target_mask

    @property
    def cut_depth(self) -> Float[Tensor, "height width"]:
        """The proxy's depth, 0 outside of `target_mask` if there is one."""
        return self.depth if self.target_mask is None else self.depth * (self.target_mask > 0)

    @property
    def missing(self) -> Float[Tensor, "height width"]:
        """E where the subject may be: not outside of `target_mask`, if there is one."""
        return self.error if self.target_mask is None else self.error * (self.target_mask > 0)

    @property
    def refine_mask(self) -> Bool[Tensor, "height width"]:
        """Pixels to re-synthesise: those with E > 0 that are not only attenuated."""
        return self.error > 0 if self.fade is None else (self.error > 0) & (self.fade == 0)

    @cached_property
    def coloured(self) -> Bool[Tensor, "height width"]:
        """Pixels that a source view colours."""
        return self.weights.sum(0) > 0  # seven times faster than `any` along an axis

    @cached_property
    def holes(self) -> Bool[Tensor, "height width"]:
        """Pixels of the proxy that no source view colours: the paper's E, whatever the error rule."""
        return (self.mask > 0) & ~self.coloured

    @cached_property
    def depth_with_rim(self) -> Float[Tensor, "height width"]:
        """The proxy's depth, metres, extended by a rim of few pixels (`rim_depth`)."""
        return rim_depth(self.depth)

    def closest_views(self, count: int) -> tuple[str, ...]:
        """Names of up to `count` cameras: the source views, then the closest other candidates."""
        return tuple(dict.fromkeys((*self.source_views, *self.candidate_views)))[:count]

    def check(self, known: Sequence[str]) -> None:
        """ValueError unless the view is what its fields say, and its cameras are among these."""
        unknown = sorted({*self.source_views, *self.candidate_views} - set(known))
        if unknown:
            raise ValueError(
                f"expected a view of cameras among {list(known)}, got {unknown}; correct source_views and "
                "candidate_views"
            )
        if not self.source_views:
            raise ValueError(
                "expected source_views with a camera, got none; name those that coloured the view"
            )
        self.camera.check_single()
        width, height = self.camera.max_size_px
        check_target_mask(self.target_mask, (height, width))
        self._check_images(height, width)
        if self.silhouettes is not None:
            self.silhouettes.check()

    def _check_images(self, height: int, width: int) -> None:
        """The checks of the images but `target_mask`: their types and shapes, then their ranges."""
        plane = (height, width)
        shapes = {
            "rgb": (3, *plane),
            "weights": (len(self.source_views), *plane),
            "mask": plane,
            "error": plane,
            "depth": plane,
        }
        if self.fade is not None:
            shapes["fade"] = plane

        # types and shapes
        images: dict[str, Tensor] = {}
        for name, shape in shapes.items():
            what = "one image for each of source_views" if name == "weights" else "it channels first"
            arrange = f"give {what}, at the size of the view's camera"
            value = getattr(self, name)
            images[name] = check_tensor(
                name, value, (torch.float32,), shape, convert=TO_FLOAT, arrange=arrange
            )

        # ranges
        sums = self.weights.sum(0)
        off_by = sums * (1 - sums)  # 0 where the sum is 0 or 1
        *ranges, (low, high) = extremes([*images.values(), off_by])
        for name, (smallest, largest) in zip(images, ranges, strict=True):
            check_range(name, smallest, largest, most=math.inf if name == "depth" else 1.0)
        if low < -SUM_TOLERANCE or high > SUM_TOLERANCE:
            raise ValueError(
                "expected weights that sum to 1 or 0 in each pixel, got others; divide them by their sum"
            )


def check_range(name: str, low: float, high: float, most: float = 1.0) -> None:
    """ValueError unless an image's smallest and largest value are finite and in [0, most], up to a tolerance."""
    if not math.isfinite(low + high):
        raise ValueError(
            f"expected finite numbers in {name}, got NaN or infinity; use 0 where there is no surface"
        )
    if low < -OVERSHOOT or high > most + OVERSHOOT:
        how = (
            "divide 8-bit images by 255, and clamp others" if most == 1 else "use 0 where there is no surface"
        )
        raise ValueError(f"expected {name} in [0, {most:g}], got values from {low:.3g} to {high:.3g}; {how}")


def check_target_mask(mask: object, shape: Sequence[int]) -> None:
    """ValueError unless this is None, or numbers in [0, 1] of this height and width."""
    if mask is None:
        return
    arrange = "give the mask of this view at its size, (height, width)"
    image = check_tensor("target_mask", mask, (torch.float32,), shape, convert=TO_FLOAT, arrange=arrange)
    check_range("target_mask", *extremes([image])[0])


@dataclass(frozen=True)
class CompletedView:
    """A completed novel view: Fhat = E * Ftilde + (1 - E) * F (section 1).

    Examples:
        >>> import torch
        >>> from viewmend import CompletedView, IncompleteView, pinhole
        >>> camera = pinhole(0.8, 64, 48, torch.eye(4))
        >>> rgb, ones, weights = torch.zeros(3, 48, 64), torch.ones(48, 64), torch.zeros(1, 48, 64)
        >>> view = IncompleteView(camera, rgb, ones, ones, 2 * ones, source_views=("left",), weights=weights, time=0)
        >>> completed = CompletedView(view, rgb + 0.5)
        >>> torch.equal(completed.opacity, view.mask), list(completed.images)
        (True, ['rgb'])
    """

    view: IncompleteView
    rgb: Float[Tensor, "3 height width"]
    """Fhat, in [0, 1], on black; equal to `view.cut_rgb` bit for bit where E is 0."""
    alpha: Float[Tensor, "height width"] | None = None
    """Coverage of each pixel by the subject, in [0, 1]; `rgb` is multiplied by it. None if nothing is
    known beyond the view's silhouette."""
    confidence: Float[Tensor, "height width"] | None = None
    """Confidence of the model in each pixel, in [0, 1]; 0 where there is no subject. None if it
    predicts none."""
    depth: Float[Tensor, "height width"] | None = None
    """Refined z-depth of the subject, metres, 0 where there is none. None if the model predicts none."""

    @property
    def opacity(self) -> Float[Tensor, "height width"]:
        """`alpha`, or the view's silhouette if the model predicts none."""
        return self.view.silhouette if self.alpha is None else self.alpha

    @property
    def surface_depth(self) -> Float[Tensor, "height width"]:
        """`depth`, or the proxy's if the model predicts none; metres, 0 where there is no subject."""
        return self.view.cut_depth if self.depth is None else self.depth

    @property
    def straight_rgb(self) -> Float[Tensor, "3 height width"]:
        """Fhat divided by `opacity`, in [0, 1]: straight (not premultiplied) colours.

        Pixels of almost no opacity take the colour of their neighbours, so that no dark fringe
        appears when the image is scaled or compressed; far from the subject the image is black.
        """
        opacity = self.opacity[None]
        near = F.avg_pool2d(torch.cat([self.rgb, opacity])[None], 2 * NEAR_PX + 1, 1, NEAR_PX)[0]
        tiny = torch.finfo(near.dtype).tiny
        spread = near[:3] / near[3:].clamp(min=tiny)
        own = self.rgb / opacity.clamp(min=FAINT)
        return torch.where(opacity < FAINT, spread, own).clamp(0, 1)

    @property
    def images(self) -> dict[str, Float[Tensor, "*channel height width"]]:
        """All images that are not None, by the names of their fields."""
        found = {name: getattr(self, name) for name in ("rgb", "alpha", "confidence", "depth")}
        return {name: image for name, image in found.items() if image is not None}
