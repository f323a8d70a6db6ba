"""One worker per camera: it reads images, reconnects after failures, makes masks, and delivers the result."""

import contextlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from queue import Empty, Queue
from typing import Any

import numpy as np

from viewmend.contrib.live_rig.frame_readers import Picture
from viewmend.contrib.live_rig.rig_file import LiveCamera
from viewmend.data.errors import CaptureError
from viewmend.data.native_capture import CameraImages, Undistortion
from viewmend.data.videos import is_turned, to_rgb
from viewmend.preprocess.masks.maker import Mask, MaskMaker, Rgb
from viewmend.preprocess.masks.person import PersonMasks
from viewmend.preprocess.masks.plate import PlateMasks, read_plate


class ReducedMasks:
    """Makes masks of reduced images, and enlarges them."""

    def __init__(self, maker: MaskMaker, size_px: tuple[int, int]) -> None:
        self._maker = maker
        self._size_px = size_px

    def mask(self, rgb: Rgb) -> Mask:
        """Foreground of the next image, of its size.

        Raises:
            ValueError: the image is not of the size that the maker was made for.
        """
        import cv2

        small = self._maker.mask(reduced(rgb, self._size_px))
        return np.asarray(cv2.resize(small, rgb.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.uint8)


def reduced(rgb: Rgb, size_px: tuple[int, int]) -> Rgb:
    """The image resized to this width and height; unchanged if it has them."""
    import cv2

    if rgb.shape[1::-1] == size_px:
        return rgb
    return np.asarray(cv2.resize(rgb, size_px, interpolation=cv2.INTER_AREA), np.uint8)


def mask_maker(camera: LiveCamera) -> MaskMaker:
    """The mask maker of a camera, by its rig's settings.

    Raises:
        CaptureError: its clean plate is missing, unreadable or of another size.
    """
    size_px = camera.calibration.width, camera.calibration.height
    small_px = max(1, round(size_px[0] * camera.mask.scale)), max(1, round(size_px[1] * camera.mask.scale))
    if camera.mask.method == "person":
        maker = PersonMasks()
    else:
        where = f"{camera.plate}: the clean plate of camera '{camera.name}'"
        plate = read_plate(camera.plate, where)
        if plate.shape[1::-1] != camera.taken_px:
            expected, got = ("{} x {}".format(*size) for size in (camera.taken_px, plate.shape[1::-1]))
            raise CaptureError(f"{where}: expected {expected} pixels as the calibration says, got {got}; take it again")
        maker = PlateMasks(reduced(plate, small_px))
    return maker if small_px == size_px else ReducedMasks(maker, small_px)


FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 1.0
"""Pause between attempts to connect; it doubles each time."""
TAKE_S = 0.2
PERIOD_FOLLOWS = 0.05
"""Weight of the newest interval in the estimate of the interval between images."""

log = logging.getLogger("viewmend.live")


class CameraInput:
    """Reduces, masks and undistorts the images of one camera."""

    def __init__(self, camera: LiveCamera) -> None:
        """Set up.

        Raises:
            CaptureError: the camera's clean plate is missing, or of another size.
        """
        self._camera = camera
        self._masks = mask_maker(camera)
        self._undistortion = Undistortion(camera.calibration)

    def images(self, picture: Picture) -> CameraImages:
        """The image and mask of a picture.

        Raises:
            ValueError: it has another size than the calibration.
        """
        frame, camera = picture.frame, self._camera.calibration
        size = (frame.height, frame.width) if is_turned(frame) else (frame.width, frame.height)
        if size != self._camera.taken_px:
            expected = "{} x {}".format(*self._camera.taken_px)
            raise ValueError(
                f"expected pictures of {expected} as the calibration says, got {size[0]} x {size[1]}; "
                "set the camera's mode in 'options'"
            )
        rgb = to_rgb(frame, (camera.width, camera.height))
        return self._undistortion.apply(CameraImages(rgb, self._masks.mask(rgb), None))


def pauses() -> Iterator[float]:
    """Pauses between attempts to connect, seconds."""
    pause_s = FIRST_PAUSE_S
    while True:
        yield pause_s
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)


class CameraWorker:
    """Two threads of one camera: one reads and decodes, one makes masks of the newest image."""

    def __init__(
        self,
        camera: LiveCamera,
        connect: Callable[["CameraWorker"], Any],
        deliver: Callable[[str, float, CameraImages], None],
        wants: Callable[[float, float], bool],
    ) -> None:
        """Set up.

        Raises:
            CaptureError: the camera's clean plate is missing, or of another size.
        """
        self.camera = camera
        self.counts: Counter[str] = Counter()
        self.up = False
        """Whether the camera delivers images."""
        self.error: str | None = None
        """Why not, or what is wrong with its images."""
        self._input = CameraInput(camera)
        self._connect, self._deliver, self._wants = connect, deliver, wants
        self._since_s = time.monotonic()
        """When `up` changed last."""
        self._last_s: float | None = None
        self._period_s = 0.0
        self._newest: Queue[Picture] = Queue(1)
        """The newest image, until it is taken."""
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(target=work, name=f"{camera.name} {work.__name__}", daemon=True)
            for work in (self.read, self.work)
        ]

    def start(self) -> None:
        """Start both threads."""
        for thread in self._threads:
            thread.start()

    def ask_to_stop(self) -> None:
        """Request the end; `stop` waits for it."""
        self._stopped.set()

    def stop(self) -> None:
        """End; a silent camera is abandoned after a few seconds."""
        self._stopped.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=3)

    def wait(self, seconds: float) -> bool:
        """Wait; returns whether the worker must end."""
        return self._stopped.wait(max(0.0, seconds)) if seconds > 0 else self._stopped.is_set()

    def read(self) -> None:
        """Read images, reconnecting after failures, until stopped."""
        pause = pauses()
        while not self._stopped.is_set():
            began_s = time.monotonic()
            try:
                with contextlib.closing(self._connect(self)) as pictures:
                    for picture in pictures:
                        if not self.up:
                            self._is_up()
                            pause = pauses()
                        self._offer(picture)
                        if self._stopped.is_set():
                            return
                if not self._stopped.is_set():
                    self._is_down("its pictures have ended")
            except Exception as error:  # any failure is reported, and the camera tried again
                self._is_down(str(error) or type(error).__name__)
            if self.wait(began_s + next(pause) - time.monotonic()):
                return

    def work(self) -> None:
        """Process the newest image, again and again, until stopped."""
        while not self._stopped.is_set():
            try:
                picture = self._newest.get(timeout=TAKE_S)
                images = self._input.images(picture)
            except Empty:
                continue
            except ValueError as error:
                self.counts["refused"] += 1
                self._say(str(error))
                continue
            self._deliver(self.camera.name, picture.taken_s, images)

    def _offer(self, picture: Picture) -> None:
        """Pass on an image if its time is wanted."""
        if self._last_s is not None and 0 < picture.taken_s - self._last_s < 1:
            step_s = picture.taken_s - self._last_s
            self._period_s += PERIOD_FOLLOWS * (step_s - self._period_s) if self._period_s else step_s
        self._last_s = picture.taken_s
        self.counts["read"] += 1
        if not self._wants(picture.taken_s, self._period_s):
            self.counts["thinned"] += 1
            return
        with contextlib.suppress(Empty):  # one that was not taken is replaced
            self._newest.get_nowait()
            self.counts["replaced"] += 1
        self._newest.put(picture)

    def _is_up(self) -> None:
        gone_s = time.monotonic() - self._since_s
        self.up, self.error, self._since_s = True, None, time.monotonic()
        self.counts["connects"] += 1
        log.warning("camera '%s' is there, after %.1f s", self.camera.name, gone_s)

    def _is_down(self, reason: str) -> None:
        if self.up:
            self._since_s = time.monotonic()
        self.up = False
        self._say(reason)

    def _say(self, error: str) -> None:
        """Report an error, once until it changes."""
        if error != self.error:
            log.warning("camera '%s': %s", self.camera.name, error)
        self.error = error
