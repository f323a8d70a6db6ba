"""One camera's worker: it comes back, and the newest picture wins."""

import itertools
import threading
from contextlib import contextmanager
from dataclasses import replace

import av
import numpy as np
import pytest
from live.live_servers import WAIT_S, wait_until
from reference.ball_rig import CAMERAS

from viewmend.contrib.live_rig.frame_readers import DecodedImage
from viewmend.contrib.live_rig.rig_file import read_rig
from viewmend.contrib.live_rig.worker import CameraWorker

SIZE = CAMERAS.max_size_px


@contextmanager
def working(camera, connect, deliver=lambda *_: None, wants=lambda *_: True, **replaced):
    """A worker that is started and stopped; `replaced` are methods."""
    worker = CameraWorker(camera, connect, deliver, wants)
    vars(worker).update(replaced)
    worker.start()
    yield worker
    worker.stop()


def frame(size=SIZE):
    rgb = np.full((size[1], size[0], 3), 200, np.uint8)
    return av.VideoFrame.from_ndarray(rgb, format="rgb24")


@pytest.fixture
def camera(ball_rig):
    return read_rig(ball_rig / "rig.toml").cameras[0]


def test_a_camera_that_fails_is_reached_again(camera):
    """Six times it is not there, once it ends, once its connection breaks with whatever it likes."""
    attempts, waits = itertools.count(), []
    here, go_on = threading.Event(), threading.Event()

    def connect(worker):
        attempt = next(attempts)
        if attempt < 6:
            raise OSError("nobody there")
        yield DecodedImage(frame(), 10.0 + attempt)
        if attempt == 7:
            raise ZeroDivisionError("what a decoder may raise")
        if attempt == 8:
            here.set()
            go_on.wait(WAIT_S)
            raise OSError("the stream has ended")

    def wait(seconds):
        waits.append(round(seconds, 1))
        return go_on.is_set()

    with working(camera, connect, wait=wait) as worker:
        assert here.wait(WAIT_S) and worker.up and worker.error is None
        assert worker.counts["read"] == worker.counts["connects"] == 3
        go_on.set()
    assert not worker.up and worker.error == "the stream has ended"
    expected = [0.1, 0.2, 0.4, 0.8, 1.0, 1.0, 0.1, 0.1]
    assert waits[:8] == expected, "pauses grow and stay short; a camera that was there is tried at once"


def test_pictures_of_another_size_are_refused_and_said(camera):
    said = threading.Event()

    def connect(worker):
        for n in range(3):
            yield DecodedImage(frame((64, 48)), float(n))
            wait_until(lambda n=n: worker.counts["refused"] > n)
        yield DecodedImage(frame(), 3.0)
        worker.wait(WAIT_S)

    with working(camera, connect, lambda *_: said.set()) as worker:
        assert said.wait(WAIT_S)
    expected = "expected images of 48 x 48 pixels as the calibration says, got 64 x 48; "
    expected += "set the camera's mode in 'options'"
    assert worker.counts["refused"] == 3 and worker.error == expected


def test_a_mask_that_fails_costs_one_picture(camera):
    delivered = threading.Event()

    class Masks:
        images = 0

        def mask(self, rgb):
            self.images += 1
            if self.images == 1:
                raise RuntimeError("out of memory")
            return np.zeros(rgb.shape[:2], np.uint8)

    def connect(worker):
        yield DecodedImage(frame(), 0.0)
        wait_until(lambda: worker.counts["refused"] == 1)
        yield DecodedImage(frame(), 1.0)
        worker.wait(WAIT_S)

    with working(camera, connect, lambda *_: delivered.set(), _masks=Masks()) as worker:
        assert delivered.wait(WAIT_S)
    assert worker.counts["refused"] == 1 and worker.error == "out of memory"


def test_colours_are_corrected_as_the_calibration_says(camera):
    """As in a capture; masks are made before, because a clean plate has the camera's own colours."""
    delivered = []
    masked = []

    class Masks:
        def mask(self, rgb):
            masked.append(int(rgb[0, 0, 0]))
            return np.zeros(rgb.shape[:2], np.uint8)

    def connect(worker):
        yield DecodedImage(frame(), 0.0)
        worker.wait(WAIT_S)

    halved = np.array([[0, 0.5, 0], [0, 1, 0], [0, 1, 10]])
    corrected = replace(camera, calibration=replace(camera.calibration, colour=halved))
    with working(corrected, connect, lambda *images: delivered.append(images[2]), _masks=Masks()):
        wait_until(lambda: delivered)
    assert delivered[0].rgb[24, 24].tolist() == [100, 200, 210] and masked == [200]


def test_a_slow_mask_costs_pictures_and_never_delay(camera):
    delivered, go_on = [], threading.Event()

    def connect(worker):
        for n in range(50):
            yield DecodedImage(frame(), float(n))
        go_on.set()
        worker.wait(WAIT_S)

    def process(decoded):
        go_on.wait(WAIT_S)

    with working(
        camera, connect, lambda name, taken_s, _: delivered.append(taken_s), _process=process
    ) as worker:
        wait_until(lambda: 49.0 in delivered)
    assert len(delivered) <= 2 and worker.counts["replaced"] == 50 - len(delivered)


def test_pictures_that_nobody_wants_are_not_masked(camera):
    wanted = []

    def connect(worker):
        for n in range(20):
            yield DecodedImage(frame(), n / 10)
        worker.wait(WAIT_S)

    with working(camera, connect, wants=lambda at_s, period_s: wanted.append(period_s)) as worker:
        wait_until(lambda: len(wanted) == 20)
    assert worker.counts["thinned"] == 20 and wanted[-1] == pytest.approx(0.1)
