"""One worker a camera: it reads, comes back after failures, makes masks, and hands on what is done."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

from viewmend.capture.camera_reader import CameraImages, Undistortion
from viewmend.capture.live_rig.masks import mask_maker
from viewmend.capture.live_rig.pictures import Picture
from viewmend.capture.live_rig.rig_file import LiveCamera
from viewmend.capture.live_rig.slot import Slot

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 1.0
"""From one attempt to reach a camera to the next: each time twice as long."""
TAKE_S = 0.2
PERIOD_FOLLOWS = 0.05
"""How much of a step from picture to picture the estimate of them takes over."""

log = logging.getLogger("viewmend.live")


class CameraInput:
    """Makes of one camera's pictures what is rendered from: small enough, masked, straightened."""

    def __init__(self, camera: LiveCamera) -> None:
        """Set up.

        Raises:
            CaptureError: the camera's clean plate is missing, or of another size.
        """
        self._camera = camera
        self._masks = mask_maker(camera)
        self._undistortion = Undistortion(camera.calibration)

    def images(self, picture: Picture) -> CameraImages:
        """A picture's images.

        Raises:
            ValueError: it has another size than the calibration.
        """
        frame, camera = picture.frame, self._camera.calibration
        if (frame.width, frame.height) != self._camera.taken_px:
            expected = "{} x {}".format(*self._camera.taken_px)
            raise ValueError(
                f"expected pictures of {expected} as the calibration says, got {frame.width} x {frame.height}; "
                "set the camera's mode in 'options'"
            )
        rgb = frame.to_ndarray(format="rgb24", width=camera.width, height=camera.height, interpolation="AREA")
        return self._undistortion.straight(CameraImages(rgb, self._masks.mask(rgb), None))


def pauses() -> Iterator[float]:
    """How long there is from one attempt to reach a camera to the next."""
    pause_s = FIRST_PAUSE_S
    while True:
        yield pause_s
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)


class CameraWorker:
    """Two threads of one camera: one reads and decodes, one masks. Between them is one slot, where the newest wins."""

    def __init__(
        self,
        camera: LiveCamera,
        connect: Callable[["CameraWorker"], Any],
        deliver: Callable[[str, float, CameraImages], None],
        wants: Callable[[float, float], bool],
    ) -> None:
        """Set up.

        Args:
            camera: where it is.
            connect: gives the pictures from now on, as a generator (`pictures_of`).
            deliver: takes name, time and images of a picture that is done.
            wants: whether a picture of that time, of pictures so many seconds apart, is wanted.

        Raises:
            CaptureError: the camera's clean plate is missing, or of another size.
        """
        self.camera = camera
        self.counts: Counter[str] = Counter()
        self.up = False
        """Whether pictures come."""
        self.error: str | None = None
        """Why not, or what is wrong with them."""
        self._input = CameraInput(camera)
        self._connect, self._deliver, self._wants = connect, deliver, wants
        self._since_s = time.monotonic()
        """Since when it is up, or not."""
        self._last_s: float | None = None
        self._period_s = 0.0
        self._slot: Slot[Picture] = Slot()
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(target=work, name=f"{camera.name} {work.__name__}", daemon=True)
            for work in (self.read, self.work)
        ]

    def start(self) -> None:
        """Begin."""
        for thread in self._threads:
            thread.start()

    def ask_to_stop(self) -> None:
        """Begin to end; `stop` waits for it."""
        self._stopped.set()

    def stop(self) -> None:
        """End; a camera that is silent is left alone after some seconds."""
        self._stopped.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=3)

    def wait(self, seconds: float) -> bool:
        """Wait; whether the worker is to end."""
        return self._stopped.wait(max(0.0, seconds)) if seconds > 0 else self._stopped.is_set()

    def read(self) -> None:
        """Read, and reach the camera again when it fails, until stopped."""
        pause = pauses()
        while not self._stopped.is_set():
            began_s = time.monotonic()
            try:
                with closing(self._connect(self)) as pictures:
                    for picture in pictures:
                        if not self.up:
                            self._is_up()
                            pause = pauses()
                        self._offer(picture)
                        if self._stopped.is_set():
                            return
                if not self._stopped.is_set():
                    self._is_down("its pictures have ended")
            except Exception as error:  # whatever a camera does wrong, it is said, and tried again
                self._is_down(str(error) or type(error).__name__)
            if self.wait(began_s + next(pause) - time.monotonic()):
                return

    def work(self) -> None:
        """Make images of the newest picture, again and again, until stopped."""
        while not self._stopped.is_set():
            picture = self._slot.take(TAKE_S)
            if picture is None:
                continue
            try:
                images = self._input.images(picture)
            except ValueError as error:
                self.counts["refused"] += 1
                self._say(str(error))
                continue
            self._deliver(self.camera.name, picture.taken_s, images)

    def _offer(self, picture: Picture) -> None:
        """Put a picture into the slot if its time is wanted."""
        if self._last_s is not None and 0 < picture.taken_s - self._last_s < 1:
            step_s = picture.taken_s - self._last_s
            self._period_s += PERIOD_FOLLOWS * (step_s - self._period_s) if self._period_s else step_s
        self._last_s = picture.taken_s
        self.counts["read"] += 1
        if not self._wants(picture.taken_s, self._period_s):
            self.counts["thinned"] += 1
        elif self._slot.put(picture):
            self.counts["replaced"] += 1

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
        """Tell what is wrong, once until it changes."""
        if error != self.error:
            log.warning("camera '%s': %s", self.camera.name, error)
        self.error = error
