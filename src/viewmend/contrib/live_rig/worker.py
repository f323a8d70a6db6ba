"""Workers, one per camera, that read images, reconnect after failures, make masks and deliver the results."""

import contextlib
import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator
from queue import Empty, Queue

import numpy as np

from viewmend.contrib.live_rig.frame_readers import DecodedImage
from viewmend.contrib.live_rig.rig_file import LiveCamera
from viewmend.data.camera_images import CameraImages
from viewmend.data.camera_reader import colour_curves
from viewmend.data.errors import CaptureError
from viewmend.data.undistortion import Undistortion
from viewmend.data.videos import is_turned
from viewmend.preprocess.masks.maker import MaskMaker, Rgb
from viewmend.preprocess.masks.person import PersonMasks
from viewmend.preprocess.masks.plate import PlateMasks, read_plate

FIRST_INTERVAL_S = 0.1
"""The second attempt to connect begins at least this many seconds after the first; the interval doubles with
each further attempt."""
MAX_INTERVAL_S = 1.0
"""The interval between attempts to connect grows to at most this many seconds."""
POLL_S = 0.2
"""A thread that waits for images checks at this interval, in seconds, whether it has to end."""
PERIOD_GAIN = 0.05
"""Weight of the newest interval between two images in the moving average of these intervals."""
MAX_PERIOD_S = 1.0
"""Longer intervals between two images, in seconds, are interruptions."""

log = logging.getLogger("viewmend.live")


def reduce_image(rgb: Rgb, size_px: tuple[int, int]) -> Rgb:
    """An image reduced to this width and height; unchanged if it already has this size."""
    import cv2

    height, width = rgb.shape[:2]
    if (width, height) == size_px:
        return rgb
    return np.asarray(cv2.resize(rgb, size_px, interpolation=cv2.INTER_AREA), np.uint8)


def mask_size_px(camera: LiveCamera) -> tuple[int, int]:
    """Width and height at which a camera's masks are made."""
    width = max(1, round(camera.calibration.width * camera.mask.scale))
    height = max(1, round(camera.calibration.height * camera.mask.scale))
    return width, height


def mask_maker(camera: LiveCamera) -> MaskMaker:
    """Create a camera's mask maker as its rig's settings say, for images of `mask_size_px`.

    Raises:
        CaptureError: its clean plate is missing, unreadable or of another size.
    """
    if camera.mask.method == "person":
        return PersonMasks()
    where = f"{camera.plate}: the clean plate of camera '{camera.name}'"
    plate = read_plate(camera.plate, where)
    height, width = plate.shape[:2]
    if (width, height) != camera.sent_px:
        expected = "{} x {}".format(*camera.sent_px)
        got = f"{width} x {height}"
        raise CaptureError(
            f"{where}: expected {expected} pixels as the calibration says, got {got}; take it again"
        )
    return PlateMasks(reduce_image(plate, mask_size_px(camera)))


class CameraWorker:
    """Two threads for one camera: one reads and decodes images, the other makes masks of the newest one."""

    def __init__(
        self,
        camera: LiveCamera,
        connect: Callable[["CameraWorker"], Generator[DecodedImage, None, None]],
        deliver: Callable[["CameraWorker", float, CameraImages], None],
        wants: Callable[[float, float], bool],
    ) -> None:
        """Set up; the threads are started by `start`.

        Args:
            camera: the camera.
            connect: connects to the camera, and generates its images until it fails.
            deliver: called with this worker, the time at which an image was taken, and the image.
            wants: returns whether an image is used; called with the time at which it was taken and the
                camera's average time between two images.

        Raises:
            CaptureError: the camera's clean plate is missing, or of another size.
        """
        self.camera = camera
        self.counts: Counter[str] = Counter()
        self.up = False
        """Whether the camera delivers images."""
        self.error: str | None = None
        """While `up` is False: why there are no images. While `up` is True: why an image was refused; of several,
        the last. None if neither has happened since the camera connected."""
        self._masks = mask_maker(camera)
        self._undistortion = Undistortion(camera.calibration)
        colour = camera.calibration.colour
        self._curves = None if colour is None else colour_curves(colour)
        self._connect = connect
        self._deliver = deliver
        self._wants = wants
        self._up_changed_s = time.monotonic()
        """When `up` last changed, on this machine's monotonic clock, as all times of this class."""
        self._last_taken_s: float | None = None
        """When the last image was taken; None before the first."""
        self._period_s = 0.0
        """Moving average of the time between two images; 0 before the second."""
        self._newest: Queue[DecodedImage] = Queue(1)
        """The newest image, until the other thread gets it."""
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(target=self.read, name=f"{camera.name} read", daemon=True),
            threading.Thread(target=self.make_masks, name=f"{camera.name} masks", daemon=True),
        ]

    def start(self) -> None:
        """Start both threads."""
        for thread in self._threads:
            thread.start()

    def ask_to_stop(self) -> None:
        """Ask both threads to end, without waiting for them."""
        self._stopped.set()

    def stop(self) -> None:
        """End the threads, and wait for them; one that a silent camera blocks is abandoned after 3 s."""
        self._stopped.set()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(timeout=3)

    def wait(self, seconds: float) -> bool:
        """Wait for some seconds, or until the worker has to end; returns whether it has to."""
        return self._stopped.wait(max(0.0, seconds))

    def read(self) -> None:
        """Read images, reconnecting after failures, until stopped."""
        interval_s = FIRST_INTERVAL_S
        while not self._stopped.is_set():
            began_s = time.monotonic()
            try:
                with contextlib.closing(self._connect(self)) as decoded_images:
                    for decoded in decoded_images:
                        if not self.up:
                            interval_s = FIRST_INTERVAL_S
                            self._note_connection()
                        self._receive(decoded)
                        if self._stopped.is_set():
                            return
                if not self._stopped.is_set():
                    self._note_failure("there are no more images")
            except Exception as error:  # after any failure, the worker connects again
                self._note_failure(str(error) or type(error).__name__)
            if self.wait(began_s + interval_s - time.monotonic()):
                return
            interval_s = min(2 * interval_s, MAX_INTERVAL_S)

    def _note_connection(self) -> None:
        now_s = time.monotonic()
        log.warning("camera '%s' is connected, after %.1f s", self.camera.name, now_s - self._up_changed_s)
        self.up = True
        self.error = None
        self._up_changed_s = now_s
        self.counts["connects"] += 1

    def _note_failure(self, reason: str) -> None:
        if self.up:
            self._up_changed_s = time.monotonic()
        self.up = False
        self._report(reason)

    def make_masks(self) -> None:
        """Mask and deliver images, always the newest one next, until stopped."""
        while not self._stopped.is_set():
            try:
                decoded = self._newest.get(timeout=POLL_S)
            except Empty:
                continue
            try:
                images = self._process(decoded)
            except Exception as error:  # after any failure, the worker goes on with the next image
                self.counts["refused"] += 1
                self._report(str(error) or type(error).__name__)
                continue
            self._deliver(self, decoded.taken_s, images)

    def _process(self, decoded: DecodedImage) -> CameraImages:
        """The image with its mask, reduced, with corrected colours and undistorted.

        ValueError if its size is not the calibration's.
        """
        import cv2

        frame = decoded.frame
        stored_px = (frame.width, frame.height)
        upright_px = stored_px[::-1] if is_turned(frame) else stored_px
        if upright_px != self.camera.sent_px:
            expected = "{} x {}".format(*self.camera.sent_px)
            got = "{} x {}".format(*upright_px)
            raise ValueError(
                f"expected images of {expected} pixels as the calibration says, got {got}; "
                "set the camera's mode in 'options'"
            )
        size_px = self.camera.calibration.width, self.camera.calibration.height
        rgb = decoded.to_rgb(size_px)
        mask = self._masks.mask(reduce_image(rgb, mask_size_px(self.camera)))
        full_mask = np.asarray(cv2.resize(mask, size_px), np.uint8)

        # Colours are corrected after masking, because a clean plate has the camera's own colours
        corrected = rgb if self._curves is None else np.asarray(cv2.LUT(rgb, self._curves), np.uint8)
        return self._undistortion.apply(CameraImages(corrected, full_mask, depth=None))

    def _receive(self, decoded: DecodedImage) -> None:
        """Hand a new image to the other thread if it is wanted, in place of one that still waits there."""
        self._update_period(decoded.taken_s)
        self.counts["read"] += 1
        if not self._wants(decoded.taken_s, self._period_s):
            self.counts["thinned"] += 1
            return
        with contextlib.suppress(Empty):
            self._newest.get_nowait()
            self.counts["replaced"] += 1
        self._newest.put(decoded)

    def _update_period(self, taken_s: float) -> None:
        """Update the average time between two images with the time of a new one."""
        step_s = 0.0 if self._last_taken_s is None else taken_s - self._last_taken_s
        self._last_taken_s = taken_s
        if not 0 < step_s < MAX_PERIOD_S:
            return
        if self._period_s == 0:
            self._period_s = step_s
        else:
            self._period_s += PERIOD_GAIN * (step_s - self._period_s)

    def _report(self, error: str) -> None:
        """Set the camera's error, and log it if it is a new one."""
        if error != self.error:
            log.warning("camera '%s': %s", self.camera.name, error)
        self.error = error
