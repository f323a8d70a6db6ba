"""Fused meshes and completed virtual cameras of the frames that pages draw, made while no viewer waits for a view."""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch.nn.functional as F

from viewmend.live.assets import MEMORY_MB, Asset, CompletedImage, FrameKey
from viewmend.live.renderer import Renderer
from viewmend.live.sessions import ShownFrame
from viewmend.utils.cancellation import CancelledError

RETRY_S = 10.0
"""Playing frames are tried again after this many seconds, if a mesh or view took longer than one frame."""
MAX_DRAWN = 64
"""Frames that pages have asked for and that are remembered."""

log = logging.getLogger("viewmend.live")


@dataclass(frozen=True)
class CompletedOrder:
    """One mesh or completed view to make."""

    key: FrameKey
    """The frame, and the cameras that are left out."""
    number: int | None
    """Number of the virtual camera; None for the mesh."""


@dataclass
class MadeAhead:
    """What was made of a frame."""

    mesh: Asset | None = None
    images: dict[int, CompletedImage] = field(default_factory=dict)
    """Completed views by the number of their virtual camera."""

    def count(self) -> int:
        """The number of meshes and completed views."""
        return len(self.images) + (self.mesh is not None)

    def size_bytes(self) -> int:
        """Bytes of all of them."""
        mesh_bytes = 0 if self.mesh is None else len(self.mesh.content)
        return mesh_bytes + sum(len(image.asset.content) for image in self.images.values())


class CompletedAhead:
    """Chooses what to make next, and keeps what was made. Callable from any thread."""

    def __init__(self, renderer: Renderer, memory_mb: float = MEMORY_MB) -> None:
        self._renderer = renderer
        self._max_bytes = 1e6 * memory_mb
        self._lock = threading.Lock()
        self._version: str | None = None
        self._drawn: OrderedDict[FrameKey, None] = OrderedDict()
        """Frames that pages draw; the ones asked for last at the end."""
        self._made: OrderedDict[FrameKey, MadeAhead] = OrderedDict()
        """What was made of each frame; the frames used last at the end."""
        self._size_bytes = 0
        self._failed: set[FrameKey] = set()
        self._took_s = {"mesh": 0.0, "view": 0.0}
        """Seconds that the last one of each kind took. One that was cancelled can only raise this."""
        self._tried_s = -RETRY_S
        """When something of a playing frame was last begun."""
        self.changes = 0
        """Grows with every mesh and completed view."""

    def note_drawn(self, key: FrameKey) -> None:
        """Note that a page draws a frame: it has asked for its assets."""
        with self._lock:
            self._forget_other_rigs()
            self._drawn[key] = None
            self._drawn.move_to_end(key)
            while len(self._drawn) > MAX_DRAWN:
                self._drawn.popitem(last=False)

    def counts(self) -> dict[FrameKey, int]:
        """The number of meshes and completed views of each frame that has some."""
        with self._lock:
            self._forget_other_rigs()
            return {key: made.count() for key, made in self._made.items()}

    def mesh(self, key: FrameKey) -> Asset | None:
        """The mesh of a frame that was fused from predicted depth; None if it was not made."""
        with self._lock:
            self._forget_other_rigs()
            return self._made.get(key, MadeAhead()).mesh

    def images(self, key: FrameKey) -> tuple[CompletedImage, ...]:
        """The completed views of a frame that were made so far."""
        with self._lock:
            self._forget_other_rigs()
            return tuple(self._made.get(key, MadeAhead()).images.values())

    def image(self, key: FrameKey, number: int) -> Asset | None:
        """The image of a virtual camera, by its number among the frame's assets; None if it was not made."""
        made = self.images(key)
        return next((image.asset for image in made if image.camera["number"] == number), None)

    def choose(self, shown: Sequence[ShownFrame]) -> CompletedOrder | None:
        """The mesh of the first of these frames that lacks something, then the view closest to its viewer."""
        rig = self._renderer.virtual_cameras
        home = self._renderer.home
        if rig is None or home is None:
            return None
        with self._lock:
            self._forget_other_rigs()
            for view in shown:
                if view.key not in self._drawn or view.key in self._failed:
                    continue
                made = self._made.get(view.key, MadeAhead())
                if made.mesh is None and self._renderer.fuses_ahead and self._is_in_time(view, "mesh"):
                    return CompletedOrder(view.key, None)
                left = [number for number in range(len(rig)) if number not in made.images]
                if not left or not self._is_in_time(view, "view"):
                    continue
                nearest = left[0]
                if view.eye is not None:
                    to_eye = F.normalize(view.eye.centers[0] - home.center, dim=0)
                    to_rig = F.normalize(rig.centers[left] - home.center, dim=1)
                    nearest = left[int((to_rig @ to_eye).argmax())]
                return CompletedOrder(view.key, nearest)
        return None

    def _is_in_time(self, view: ShownFrame, kind: str) -> bool:
        """Whether a mesh or a view is probably made before the next frame is shown."""
        return self._took_s[kind] < view.frame_s or time.monotonic() - self._tried_s > RETRY_S

    def make(self, order: CompletedOrder) -> None:
        """Make a mesh or complete a view, and keep it; called on the render thread.

        Raises:
            CancelledError: a viewer waits for a view, or the frame is no longer shown.
        """
        start = time.monotonic()
        version = self._renderer.assets_version
        self._tried_s = start
        kind = "mesh" if order.number is None else "view"
        try:
            if order.number is None:
                made = self._renderer.fuse_mesh(*order.key)
            else:
                made = self._renderer.complete_virtual_camera(*order.key, order.number)
        except CancelledError:
            self._took_s[kind] = max(self._took_s[kind], time.monotonic() - start)
            raise
        self._took_s[kind] = time.monotonic() - start
        with self._lock:
            self._forget_other_rigs()
            if version == self._version:
                self._keep(order, made)

    def give_up(self, order: CompletedOrder, error: Exception) -> None:
        """Make nothing more for a frame for which something failed."""
        log.warning("while completing views of frame %d: %s", order.key[0], error)
        with self._lock:
            self._failed.add(order.key)

    def _keep(self, order: CompletedOrder, new: Asset | CompletedImage) -> None:
        """Add a mesh or a view, and drop the frames used least recently beyond the memory."""
        made = self._made.setdefault(order.key, MadeAhead())
        self._made.move_to_end(order.key)
        self._size_bytes -= made.size_bytes()
        if isinstance(new, Asset):
            made.mesh = new
        else:
            assert order.number is not None, "views have the numbers of their cameras"
            made.images[order.number] = new
        self._size_bytes += made.size_bytes()
        while self._size_bytes > self._max_bytes and len(self._made) > 1:
            _, dropped = self._made.popitem(last=False)
            self._size_bytes -= dropped.size_bytes()
        self.changes += 1

    def _forget_other_rigs(self) -> None:
        """Drop what belongs to the rig before; called while holding the lock."""
        version = self._renderer.assets_version
        if version != self._version:
            self._version = version
            self._drawn.clear()
            self._made.clear()
            self._failed.clear()
            self._size_bytes = 0
