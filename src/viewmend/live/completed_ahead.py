"""Fused meshes and completed views of the frames that pages draw, made while no viewer waits for a view."""

import logging
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch.nn.functional as F

from viewmend.geometry.cameras import Cameras
from viewmend.live.assets import MEMORY_MB, Asset, CompletedImage, FrameKey
from viewmend.live.poses import HomeView
from viewmend.live.renderer import Renderer
from viewmend.live.sessions import ShownFrame
from viewmend.utils.cancellation import CancelledError

RETRY_S = 10.0
"""If a mesh or view failed, or took longer than a frame is shown, the next is tried after this many seconds."""
MAX_DRAWN = 64
"""This many frames that pages draw are remembered."""

log = logging.getLogger("viewmend.live")


@dataclass(frozen=True)
class AheadTask:
    """One mesh or completed view to make."""

    key: FrameKey
    """The frame, and the cameras that are left out."""
    camera: int | None
    """Number of the virtual camera, for a view; None for the mesh."""

    @property
    def frame(self) -> int:
        """The frame's index."""
        return self.key[0]

    @property
    def kind(self) -> str:
        """The kind of result: "mesh" or "view"."""
        return "mesh" if self.camera is None else "view"


@dataclass
class MadeAhead:
    """The mesh and the completed views of a frame that were made so far."""

    mesh: Asset | None = None
    """The mesh that was fused from predicted depth."""
    images: dict[int, CompletedImage] = field(default_factory=dict)
    """Completed views by the number of their virtual camera."""

    def count(self) -> int:
        """The number of meshes and completed views."""
        return len(self.images) + (self.mesh is not None)

    def size_bytes(self) -> int:
        """Bytes of the mesh and all views."""
        mesh_bytes = 0 if self.mesh is None else len(self.mesh.content)
        return mesh_bytes + sum(len(image.asset.content) for image in self.images.values())


class CompletedAhead:
    """Chooses what to make next, and keeps what was made. Its methods may be called on any thread."""

    def __init__(self, renderer: Renderer, memory_mb: float = MEMORY_MB) -> None:
        self._renderer = renderer
        self._max_bytes = 1e6 * memory_mb
        self._lock = threading.Lock()
        self._version: str | None = None
        """`Renderer.assets_version` of the rig to which all of this belongs."""
        self._drawn: OrderedDict[FrameKey, bool] = OrderedDict()
        """Frames that pages draw, in the order in which they were last requested, each with whether a mesh or a
        view of it failed."""
        self._made: OrderedDict[FrameKey, MadeAhead] = OrderedDict()
        """What was made for each frame, in the order in which frames were last added to."""
        self._size_bytes = 0
        self._logged = ""
        """The error that was logged last."""
        self._took_s = {"mesh": 0.0, "view": 0.0}
        """Seconds that the last mesh and the last view took, infinite if it failed; a cancelled one counts only
        if it took longer."""
        self._begun_s = -RETRY_S
        """When the last mesh or view was begun."""
        self.num_made = 0
        """The number of meshes and completed views that were made so far."""

    def note_drawn(self, key: FrameKey) -> None:
        """Note that a page draws a frame, because it has requested the frame's assets."""
        with self._lock:
            self._forget_other_rigs()
            self._drawn.setdefault(key, False)
            self._drawn.move_to_end(key)
            while len(self._drawn) > MAX_DRAWN:
                self._drawn.popitem(last=False)

    def counts(self) -> dict[FrameKey, int]:
        """The number of meshes and completed views of each frame that has any."""
        with self._lock:
            self._forget_other_rigs()
            return {key: made.count() for key, made in self._made.items()}

    def mesh(self, key: FrameKey) -> Asset | None:
        """A frame's mesh, fused from predicted depth; None if it was not made."""
        with self._lock:
            self._forget_other_rigs()
            return self._made.get(key, MadeAhead()).mesh

    def images(self, key: FrameKey) -> tuple[CompletedImage, ...]:
        """A frame's completed views, as far as they were made."""
        with self._lock:
            self._forget_other_rigs()
            return tuple(self._made.get(key, MadeAhead()).images.values())

    def image(self, key: FrameKey, number: int) -> Asset | None:
        """A frame's completed view, by its number among the frame's assets; None if it was not made."""
        made = self.images(key)
        return next((image.asset for image in made if image.camera["number"] == number), None)

    def choose(self, shown: Sequence[ShownFrame]) -> AheadTask | None:
        """The next mesh or view to make for the first of these frames that lacks one; None if nothing is due.

        A frame gets its mesh first, then its views, those closest to its viewer first.
        """
        cameras = self._renderer.virtual_cameras
        home = self._renderer.home
        if cameras is None or home is None:
            return None
        with self._lock:
            self._forget_other_rigs()
            for frame in shown:
                if self._drawn.get(frame.key) is not False:  # not drawn, or failed
                    continue
                made = self._made.get(frame.key, MadeAhead())
                lacks_mesh = self._renderer.makes_meshes_ahead and made.mesh is None
                if lacks_mesh and self._is_worth_trying("mesh", frame):
                    return AheadTask(frame.key, None)
                missing = [number for number in range(len(cameras)) if number not in made.images]
                if missing and self._is_worth_trying("view", frame):
                    return AheadTask(frame.key, _closest(missing, cameras, frame.eye, home))
        return None

    def _is_worth_trying(self, kind: str, frame: ShownFrame) -> bool:
        """Whether a mesh or a view would probably be made before the next frame is shown, or a retry is due."""
        return self._took_s[kind] < frame.interval_s or time.monotonic() - self._begun_s > RETRY_S

    def make(self, task: AheadTask) -> None:
        """Fuse a mesh or complete a view, and keep it; called on the render thread.

        Raises:
            CancelledError: a viewer waits for a view, or the frame is no longer shown.
        """
        start = time.monotonic()
        version = self._renderer.assets_version
        self._begun_s = start
        try:
            if task.camera is None:
                made = self._renderer.fuse_mesh(*task.key)
            else:
                made = self._renderer.complete_virtual_camera(*task.key, task.camera)
        except CancelledError:
            self._took_s[task.kind] = max(self._took_s[task.kind], time.monotonic() - start)
            raise
        self._took_s[task.kind] = time.monotonic() - start
        with self._lock:
            self._forget_other_rigs()
            if version == self._version:
                self._keep(task, made)

    def note_failure(self, task: AheadTask, error: Exception) -> None:
        """Log an error that is not the last one again, and make nothing more for the task's frame."""
        if str(error) != self._logged:
            self._logged = str(error)
            log.warning("while making the %s of frame %d: %s", task.kind, task.frame, error)
        self._took_s[task.kind] = math.inf
        with self._lock:
            if task.key in self._drawn:
                self._drawn[task.key] = True

    def _keep(self, task: AheadTask, new: Asset | CompletedImage) -> None:
        """Add a mesh or a view, and drop the frames that were added to least recently if memory is full."""
        made = self._made.setdefault(task.key, MadeAhead())
        self._made.move_to_end(task.key)
        self._size_bytes -= made.size_bytes()
        if isinstance(new, Asset):
            made.mesh = new
        else:
            assert task.camera is not None, "views have the numbers of their cameras"
            made.images[task.camera] = new
        self._size_bytes += made.size_bytes()
        while self._size_bytes > self._max_bytes and len(self._made) > 1:
            _, dropped = self._made.popitem(last=False)
            self._size_bytes -= dropped.size_bytes()
        self.num_made += 1

    def _forget_other_rigs(self) -> None:
        """Drop everything that belongs to an earlier rig; called while holding the lock."""
        version = self._renderer.assets_version
        if version != self._version:
            self._version = version
            self._drawn.clear()
            self._made.clear()
            self._size_bytes = 0


def _closest(numbers: Sequence[int], cameras: Cameras, eye: Cameras | None, home: HomeView) -> int:
    """The number of the camera that sees the subject from nearly where the eye does; the first without an eye."""
    if eye is None:
        return numbers[0]
    to_eye = F.normalize(eye.centers[0] - home.center, dim=0)
    to_cameras = F.normalize(cameras.centers[list(numbers)] - home.center, dim=1)
    return numbers[int((to_cameras @ to_eye).argmax())]
