"""Assets: what a page needs to draw the views of a frame by itself, made once per frame for all viewers.

The shape contains the vertices, faces and vertex colours of the geometry proxy, the cameras, and the
blending rule. Coordinates have 16 bits within the proxy's box, half the bytes of floats; where the
subject fills a view of the largest size, a step is a thousandth of a pixel. Arrays are stored as
differences and deflated. Browsers can inflate them without a decoder in the page. A mesh codec would
save less than a tenth of a frame's bytes, because most of them are images.

The images are the parts of the cameras' images that show the subject: JPEG with colour at full
resolution, followed by the deflated mask. Views that a model completed at other poses may be added
as further cameras, with alpha as masks. WebP would halve the resolution of colour and take more than
ten times as long, too long for live rigs. For 20 cameras of wd2, with masks, JPEG needs 0.72 MB and
30 ms for 36.6 dB; WebP of quality 90 needs 0.49 MB and 385 ms for 35.4 dB.
"""

import asyncio
import time
import zlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from msgspec import Struct

from viewmend.geometry.cameras import concatenate_cameras
from viewmend.geometry.proxy import GeometryProxy
from viewmend.live import protocol
from viewmend.live.poses import cameras_json
from viewmend.live.protocol import pack
from viewmend.rendering.blending import GRAZING
from viewmend.rendering.error_mask import MIN_WEIGHT
from viewmend.rendering.proxy_views import vertex_colours
from viewmend.rendering.view import RenderConfig
from viewmend.types import ContextViews, MultiViewFrame

JPEG_QUALITY = 80
"""JPEG quality of the cameras' images."""
MARGIN_PX = 1
"""Pixels around the subject's part of an image: a bilinear sample outside touches no foreground."""
KEPT_PX = 8
"""Pixels further than this from the subject are black: JPEG blocks that reach the subject keep
their colours."""
MASK_STEP = 17
"""Masks have 16 levels, for half the bytes of 256."""
COLOUR_STRIDE = 4
"""Vertices are coloured from images reduced by this factor: neighbouring vertices are several
pixels apart."""
READ_S = 10.0
"""Time limit for reading a frame, seconds."""
POLL_S = 0.02
"""Seconds between attempts to read a frame."""
NOT_IN_TIME = "the frame was not available in time; see /health"
"""The error of a request whose frame was not read in time."""
MAX_MAKING = 16
"""Largest number of frames whose assets are made at the same time."""
MEMORY_MB = 64.0
"""Memory for assets that are kept, in MB."""
COMPRESSION = 6
"""zlib's compression level of meshes and masks."""
COMPLETED_SOURCES = 4
"""A page colours a view from this many cameras, where some of them are completed views."""
COMPLETED_VIEW_POWER = 128
"""The exponent of the cosine between the directions to camera and viewer, where some cameras are
completed views: they stand closer to each other than real cameras."""
Names = tuple[str, ...]
FrameKey = tuple[int, Names]
"""A frame, and the cameras that are left out."""


def frame_key(index: int, without: Sequence[str]) -> FrameKey:
    """The key of a frame without some cameras, whatever their order."""
    return index, tuple(sorted(without))


class AssetQuery(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Path and query of an asset."""

    time: protocol.Count
    camera: protocol.Count | Literal["mesh"] | None = None
    """Number of the camera in the frame's list; "mesh" for the mesh that was fused from predicted
    depth; None for the shape."""
    v: protocol.ShortText = ""
    """The version in the message `rig`, with which the response never changes."""
    without: protocol.NameList = ""
    """Cameras that are not used."""
    token: str = ""


@dataclass(frozen=True)
class Asset:
    """The content of a response."""

    content: bytes
    media_type: str

    @cached_property
    def etag(self) -> str:
        """Depends on the content only, so that it is the same in all processes of a server."""
        return f'"{blake2b(self.content, digest_size=12).hexdigest()}"'


@dataclass(frozen=True)
class FrameAssets:
    """The assets of one frame."""

    shape: Asset
    images: tuple[Asset, ...]
    """One image for each camera of the shape, in its order."""

    @property
    def size_bytes(self) -> int:
        """Bytes of all assets."""
        return len(self.shape.content) + sum(len(image.content) for image in self.images)


@dataclass(frozen=True)
class CompletedImage:
    """A view that a model completed, as a further source image of a frame."""

    camera: dict[str, Any]
    """The virtual camera in the protocol's form, with its `number` among the frame's assets."""
    asset: Asset


class BusyError(Exception):
    """Too many frames are being prepared."""


class AssetStore:
    """Makes assets on demand, one frame after the other, and keeps those used last. Its methods run on one loop."""

    def __init__(
        self,
        read: Callable[[int], MultiViewFrame | None],
        make: Callable[[MultiViewFrame, Names], FrameAssets],
        memory_mb: float = MEMORY_MB,
    ) -> None:
        """Set up; `read` returns None while a frame is not in memory, and `make` is called on a thread."""
        self._read = read
        self._make = make
        self._max_bytes = 1e6 * memory_mb
        self._kept: OrderedDict[FrameKey, FrameAssets] = OrderedDict()
        self._making: dict[FrameKey, asyncio.Task[FrameAssets]] = {}
        self._turn = asyncio.Lock()
        self._version: str | None = None
        self.size_bytes = 0
        """Bytes of all assets that are kept."""

    async def get(self, index: int, version: str, without: Names = ()) -> FrameAssets:
        """The assets of a frame without some cameras; simultaneous requests for the same frame share one result.

        A new version means a new rig: all assets of the earlier one are dropped.

        Raises:
            BusyError: too many other frames are being prepared.
            TimeoutError: the frame was not read in time.
            ValueError: the frame has no geometry.
        """
        if version != self._version:
            self._kept.clear()
            self._making.clear()  # tasks of the earlier rig end, and their results are not kept
            self._version = version
            self.size_bytes = 0
        key = index, without
        kept = self._kept.get(key)
        if kept is not None:
            self._kept.move_to_end(key)
            return kept
        task = self._making.get(key)
        if task is None:
            if len(self._making) >= MAX_MAKING:
                raise BusyError("too many frames are being prepared; try again")
            task = self._making[key] = asyncio.create_task(self._prepare(key, version))
            # Its exception is retrieved even if no client waits for it any more
            task.add_done_callback(lambda done: done.cancelled() or done.exception())
        return await asyncio.shield(task)

    async def _prepare(self, key: FrameKey, version: str) -> FrameAssets:
        try:
            frame = await wait_for_frame(self._read, key[0], READ_S)
            async with self._turn:
                made = await asyncio.to_thread(self._make, frame, key[1])
            if version == self._version:
                self._kept[key] = made
                self.size_bytes += made.size_bytes
                while self.size_bytes > self._max_bytes and len(self._kept) > 1:
                    self.size_bytes -= self._kept.popitem(last=False)[1].size_bytes
            return made
        finally:
            if version == self._version:
                self._making.pop(key, None)


async def wait_for_frame(
    read: Callable[[int], MultiViewFrame | None], index: int, limit_s: float
) -> MultiViewFrame:
    """A frame once it is in memory; TimeoutError if it is not read in time."""
    end = time.monotonic() + limit_s
    while (frame := read(index)) is None:
        if time.monotonic() > end:
            raise TimeoutError(NOT_IN_TIME)
        await asyncio.sleep(POLL_S)
    return frame


def make_assets(
    frame: MultiViewFrame,
    proxy: GeometryProxy,
    config: RenderConfig,
    completed: MultiViewFrame | None = None,
    jpeg_quality: int = JPEG_QUALITY,
) -> FrameAssets:
    """The assets of a frame with masks.

    Args:
        frame: the cameras' images.
        proxy: the mesh to draw.
        config: how many cameras colour a view, and how they are weighted.
        completed: views of the same time that a model completed, with straight colours, and alpha as masks.
        jpeg_quality: quality of the images, up to 100.
    """
    cameras, images = _image_assets(frame, jpeg_quality)
    if completed is not None:
        more_cameras, more_images = completed_assets(completed, jpeg_quality)
        cameras += more_cameras
        images += more_images
    return FrameAssets(_pack_shape(frame, proxy, config, {"cameras": cameras}), tuple(images))


def make_mesh(frame: MultiViewFrame, proxy: GeometryProxy, config: RenderConfig) -> Asset:
    """Another mesh of a frame with masks: a shape without the list of cameras."""
    return _pack_shape(frame, proxy, config, {})


def _pack_shape(
    frame: MultiViewFrame, proxy: GeometryProxy, config: RenderConfig, fields: dict[str, Any]
) -> Asset:
    """The mesh and the blending rule, with more fields in the header."""
    arrays = _shape_arrays(frame, proxy)
    vertices = proxy.mesh.vertices
    blend = config.blend
    packed = {name: pack_differences(values) for name, (values, _) in arrays.items()}
    header: dict[str, Any] = {
        "time": frame.time,
        "center": (vertices.mean(0) if len(vertices) else proxy.bounds.center).tolist(),
        **fields,
        "blend": {
            "cameras": config.cameras,
            "normal_power": blend.normal_power,
            "view_power": blend.view_power,
            "bias_m": blend.depth_bias * float(proxy.bounds.size_m.norm()),
            "slope_px": blend.slope_px,
            "grazing": GRAZING,
            "min_weight": MIN_WEIGHT,
            "completed": {"cameras": COMPLETED_SOURCES, "view_power": COMPLETED_VIEW_POWER},
        },
        "parts": [
            {"kind": name, "bytes": len(packed[name]), "rows": len(values), "columns": values.shape[1]} | more
            for name, (values, more) in arrays.items()
        ],
    }
    return Asset(pack(header, list(packed.values())), "application/octet-stream")


def completed_assets(
    completed: MultiViewFrame, jpeg_quality: int = JPEG_QUALITY
) -> tuple[list[dict[str, Any]], list[Asset]]:
    """Completed views as further source images, and their cameras in the protocol's form.

    Args:
        completed: straight colours, and alpha as masks.
        jpeg_quality: quality of the images, up to 100.
    """
    cameras, images = _image_assets(completed, jpeg_quality)
    return [camera | {"completed": True} for camera in cameras], images


def _image_assets(frame: MultiViewFrame, jpeg_quality: int) -> tuple[list[dict[str, Any]], list[Asset]]:
    """Each camera's image of the subject, and the camera of that part of the image in the protocol's form."""
    cameras = []
    images = []
    lengths = []
    for n, (rgb, mask) in enumerate(zip(frame.per_camera("rgb"), frame.per_camera("mask"), strict=True)):
        top, bottom, left, right = _subject_box(mask.cpu().numpy())
        part = rgb[:, top:bottom, left:right].movedim(0, -1).contiguous().cpu().numpy()
        jpeg, packed_mask = _encode_image(part, mask[top:bottom, left:right].cpu().numpy(), jpeg_quality)
        cameras.append(frame.cameras[n].cropped(left, top, right - left, bottom - top))
        images.append(Asset(jpeg + packed_mask, "image/jpeg"))
        lengths.append(len(jpeg))
    described = cameras_json(concatenate_cameras(cameras))
    return [camera | {"jpeg_bytes": size} for camera, size in zip(described, lengths, strict=True)], images


def _shape_arrays(
    frame: MultiViewFrame, proxy: GeometryProxy
) -> dict[str, tuple[np.ndarray, dict[str, Any]]]:
    """Integer arrays of the shape by name, each with more fields of its description."""
    vertices = proxy.mesh.vertices.cpu().double().numpy()
    low, high = (vertices.min(0), vertices.max(0)) if len(vertices) else (np.zeros(3), np.zeros(3))
    step = np.maximum((high - low) / 65535, 1e-9)
    positions = np.rint((vertices - low) / step).astype(np.int64)
    faces = proxy.mesh.faces.cpu().numpy().astype(np.int64).reshape(-1, 1)
    colours = np.rint(255 * _colours(frame, proxy)).astype(np.int64)
    box = {"low": low.tolist(), "step": step.tolist()}
    return {"positions": (positions, box), "faces": (faces, {}), "colours": (colours, {})}


def _colours(frame: MultiViewFrame, proxy: GeometryProxy) -> Float[np.ndarray, "vertex 3"]:
    """RGB of the vertices in [0, 1], for what the closest cameras do not see."""
    assert frame.mask is not None, "a frame with a hull has masks"
    stride = COLOUR_STRIDE
    rig = frame.cameras
    if min(frame.mask.shape[1:]) < 64 * stride:
        stride = 1
    first = stride // 2
    rgb, mask = (image[..., first::stride, first::stride] for image in (frame.rgb, frame.mask))
    K = rig.K.clone()
    K[:, :2] /= stride
    K[:, :2, 2] += 0.5 - (first + 0.5) / stride  # the centre of pixel `first` becomes that of pixel 0
    sizes = ((rig.size_px - first + stride - 1) // stride).clamp(min=1)
    small = replace(frame, cameras=replace(rig, K=K, size_px=sizes), rgb=rgb, mask=mask)
    return vertex_colours(proxy, ContextViews(small, proxy.depth(small.cameras))).cpu().numpy()


def pack_differences(values: Int[np.ndarray, "row column"]) -> bytes:
    """Integers of 31 bits as deflated differences to the row before, folded to unsigned (0, -1, 1, -2 to 0, 1, 2, 3).

    They are stored column by column: first the lowest byte of all, then the second, the
    third and the highest.
    """
    differences = np.diff(values, axis=0, prepend=np.zeros((1, values.shape[1]), values.dtype)).T
    folded = ((differences << 1) ^ (differences >> 63)).astype("<u4")
    planes = folded.reshape(-1, 1).view(np.uint8).T
    return zlib.compress(planes.tobytes(), COMPRESSION)


def _subject_box(mask: UInt8[np.ndarray, "height width"]) -> tuple[int, int, int, int]:
    """Top, bottom, left and right of the foreground with its margin; one pixel if there is none."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    if not len(rows):
        return 0, 1, 0, 1
    height, width = mask.shape
    return (
        max(0, int(rows[0]) - MARGIN_PX),
        min(height, int(rows[-1]) + 1 + MARGIN_PX),
        max(0, int(columns[0]) - MARGIN_PX),
        min(width, int(columns[-1]) + 1 + MARGIN_PX),
    )


def _encode_image(
    rgb: UInt8[np.ndarray, "height width 3"], mask: UInt8[np.ndarray, "height width"], jpeg_quality: int
) -> tuple[bytes, bytes]:
    """JPEG and deflated mask."""
    near = cv2.dilate(mask, np.ones((2 * KEPT_PX + 1, 2 * KEPT_PX + 1), np.uint8))
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, jpeg = cv2.imencode(".jpg", cv2.bitwise_and(bgr, bgr, mask=near), options)
    assert done, "8-bit images can be encoded"
    levels = (mask.astype(np.uint16) + MASK_STEP // 2) // MASK_STEP * MASK_STEP
    return jpeg.tobytes(), zlib.compress(levels.astype(np.uint8).tobytes(), COMPRESSION)
