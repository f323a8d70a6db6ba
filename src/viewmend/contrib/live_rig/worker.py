"""One worker per camera: it reads images, reconnects after failures, makes masks, and delivers the result."""

import contextlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator
from queue import Empty, Queue

import numpy as np

from viewmend.contrib.live_rig.frame_readers import Picture
from viewmend.contrib.live_rig.rig_file import LiveCamera
from viewmend.data.camera_images import CameraImages
from viewmend.data.errors import CaptureError
from viewmend.data.undistortion import Undistortion
from viewmend.data.videos import is_turned
from viewmend.preprocess.masks.maker import MaskMaker, Rgb
from viewmend.preprocess.masks.person import PersonMasks
from viewmend.preprocess.masks.plate import PlateMasks, read_plate

FIRST_PAUSE_S = 0.1
"""The first pause between attempts to connect, in seconds; it doubles each time."""
MAX_PAUSE_S = 1.0
"""The longest pause between attempts to connect, in seconds."""
POLL_S = 0.2
"""The masking thread checks at this interval, in seconds, whether it has to end."""
PERIOD_GAIN = 0.05
"""The estimated interval between images moves by this fraction of its difference from the newest one."""

log = logging.getLogger("viewmend.live")


def reduce_image(rgb: Rgb, size_px: tuple[int, int]) -> Rgb:
    """The image resized to this width and height; unchanged if it has them."""
    import cv2

    if rgb.shape[1::-1] == size_px:
        return rgb
    return np.asarray(cv2.resize(rgb, size_px, interpolation=cv2.INTER_AREA), np.uint8)


def mask_size_px(camera: LiveCamera) -> tuple[int, int]:
    """Width and height at which a camera's masks are made."""
    size_px = camera.calibration.width, camera.calibration.height
    return max(1, round(size_px[0] * camera.mask.scale)), max(1, round(size_px[1] * camera.mask.scale))


def mask_maker(camera: LiveCamera) -> MaskMaker:
    """The mask maker of a camera, by its rig's settings, for images of `mask_size_px`.

    Raises:
        CaptureError: its clean plate is missing, unreadable or of another size.
    """
    if camera.mask.method == "person":
        return PersonMasks()
    where = f"{camera.plate}: the clean plate of camera '{camera.name}'"
    plate = read_plate(camera.plate, where)
    if plate.shape[1::-1] != camera.taken_px:
        expected, got = ("{} x {}".format(*size) for size in (camera.taken_px, plate.shape[1::-1]))
        raise CaptureError(
            f"{where}: expected {expected} pixels as the calibration says, got {got}; take it again"
        )
    return PlateMasks(reduce_image(plate, mask_size_px(camera)))


class CameraWorker:
    """Two threads of one camera: one reads and decodes, one makes masks of the newest image."""

    def __init__(
        self,
        camera: LiveCamera,
        connect: Callable[["CameraWorker"], Generator[Picture, None, None]],
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
        """Why the camera delivers no images, or what is wrong with them; None if all is well."""
        self._masks = mask_maker(camera)
        self._undistortion = Undistortion(camera.calibration)
        self._connect = connect
        self._deliver = deliver
        self._wants = wants
        self._since_s = time.monotonic()
        """When `up` changed last."""
        self._last_s: float | None = None
        """When the last image was taken; None before the first."""
        self._period_s = 0.0
        """The estimated time between two images; 0 before the second."""
        self._newest: Queue[Picture] = Queue(1)
        """The newest image, until it is taken."""
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(target=work, name=f"{camera.name} {work.__name__}", daemon=True)
            for work in (self.read, self.make_masks)
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
        return self._stopped.wait(max(0.0, seconds))

    def read(self) -> None:
        """Read images, reconnecting after failures, until stopped."""
        pause_s = FIRST_PAUSE_S
        while not self._stopped.is_set():
            began_s = time.monotonic()
            try:
                with contextlib.closing(self._connect(self)) as pictures:
                    for picture in pictures:
                        if not self.up:
                            pause_s = FIRST_PAUSE_S
                            self._note_connection()
                        self._offer(picture)
                        if self._stopped.is_set():
                            return
                if not self._stopped.is_set():
                    self._note_failure("its images have ended")
            except Exception as error:  # any failure is reported, and the camera tried again
                self._note_failure(str(error) or type(error).__name__)
            if self.wait(began_s + pause_s - time.monotonic()):
                return
            pause_s = min(2 * pause_s, MAX_PAUSE_S)

    def _note_connection(self) -> None:
        now_s = time.monotonic()
        log.warning("camera '%s' is connected, after %.1f s", self.camera.name, now_s - self._since_s)
        self.up = True
        self.error = None
        self._since_s = now_s
        self.counts["connects"] += 1

    def _note_failure(self, reason: str) -> None:
        if self.up:
            self._since_s = time.monotonic()
        self.up = False
        self._report(reason)

    def make_masks(self) -> None:
        """Mask and deliver the newest image, again and again, until stopped."""
        while not self._stopped.is_set():
            try:
                picture = self._newest.get(timeout=POLL_S)
                images = self._images(picture)
            except Empty:
                continue
            except ValueError as error:
                self.counts["refused"] += 1
                self._report(str(error))
                continue
            self._deliver(self.camera.name, picture.taken_s, images)

    def _images(self, picture: Picture) -> CameraImages:
        """The reduced and undistorted image, and its mask; ValueError for a size that is not the calibration's."""
        import cv2

        frame = picture.frame
        camera = self.camera.calibration
        size = (frame.height, frame.width) if is_turned(frame) else (frame.width, frame.height)
        if size != self.camera.taken_px:
            expected = "{} x {}".format(*self.camera.taken_px)
            raise ValueError(
                f"expected pictures of {expected} as the calibration says, got {size[0]} x {size[1]}; "
                "set the camera's mode in 'options'"
            )
        size_px = camera.width, camera.height
        rgb = picture.to_rgb(size_px)
        mask = cv2.resize(self._masks.mask(reduce_image(rgb, mask_size_px(self.camera))), size_px)
        return self._undistortion.apply(CameraImages(rgb, np.asarray(mask, np.uint8), None))

    def _offer(self, picture: Picture) -> None:
        """Pass on an image if its time is wanted."""
        if self._last_s is not None and 0 < picture.taken_s - self._last_s < 1:
            step_s = picture.taken_s - self._last_s
            self._period_s += PERIOD_GAIN * (step_s - self._period_s) if self._period_s else step_s
        self._last_s = picture.taken_s
        self.counts["read"] += 1
        if not self._wants(picture.taken_s, self._period_s):
            self.counts["thinned"] += 1
            return
        with contextlib.suppress(Empty):
            self._newest.get_nowait()  # drop an image that was not masked yet
            self.counts["replaced"] += 1
        self._newest.put(picture)

    def _report(self, error: str) -> None:
        """Report an error, once until it changes."""
        if error != self.error:
            log.warning("camera '%s': %s", self.camera.name, error)
        self.error = error
