"""`viewmend serve rig.toml`: videos as if they were live, from their files to a viewer."""

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live.live_servers import decode, get, running, wait_until
from reference.ball import photograph
from reference.ball_rig import CAMERAS, make_rig, rig_text

from viewmend.cli import main
from viewmend.contrib.live_rig.aligner import ImageGroup, TimedImages
from viewmend.contrib.live_rig.rig_file import read_rig
from viewmend.contrib.live_rig.rig_source import RigFileSource
from viewmend.data.camera_images import CameraImages
from viewmend.data.errors import CaptureError
from viewmend.live.client import Publisher


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    pytest.importorskip("av")
    return make_rig(tmp_path)


def newest(supply):
    return supply.read(supply.span.newest)


@contextmanager
def reading(supply: RigFileSource) -> Iterator[None]:
    """The supply alone, without a server."""
    supply.start()
    try:
        yield
    finally:
        supply.stop()


def of_all(supply):
    """A frame that all cameras are in, None while there is none."""
    frames = map(supply.read, reversed(range(supply.span.first, supply.span.end)))
    return next((f for f in frames if f is not None and f.cameras.names == CAMERAS.names), None)


def test_videos_as_if_live_are_masked_and_together_and_shown(rig):
    supply = RigFileSource(rig, align=False)
    with running(supply, ready=False) as server:
        wait_until(lambda: server.service.is_ready and of_all(supply) is not None)
        frame, truth = of_all(supply), photograph(CAMERAS)
        inside, true = frame.mask > 127, truth.mask > 127
        assert float((inside & true).sum() / (inside | true).sum()) > 0.93
        # One time: all videos grow darker from frame to frame, by a tenth.
        ratios = frame.rgb.sum(1) / truth.rgb.sum(1).clamp(min=1)
        assert np.ptp([float(ratio[mask].median()) for ratio, mask in zip(ratios, true, strict=True)]) < 0.04
        status, _, jpeg = get(f"{server.url}/frame.jpg?azimuth=200&width=48&height=48")
        assert status == 200 and decode(jpeg).max() > 60
        with pytest.raises(ConnectionError, match="reads its own cameras"):
            Publisher(CAMERAS, server.ws)
        lines = get(f"{server.url}/metrics")[2].decode().splitlines()
        assert 'viewmend_camera_up{camera="c0"} 1' in lines
        assert any(line.startswith("viewmend_cameras_apart_seconds 0.0") for line in lines)
        assert any(
            line.startswith('viewmend_camera_pictures_total{camera="c4",event="used"}') for line in lines
        )


def test_the_rig_changes_while_the_other_cameras_go_on(rig, caplog):
    caplog.set_level(logging.WARNING)
    supply = RigFileSource(rig, align=False)
    with reading(supply):
        wait_until(lambda: of_all(supply) is not None)
        before = supply.rig.number
        rig.write_text("nonsense")
        wait_until(lambda: "the rig stays as it was" in caplog.text)
        assert supply.rig.number == before and len(supply.camera_counts()) == 6
        supply._aligner.counts["c0"]["used"] += 1000
        rig.write_text(rig_text(CAMERAS.names[:5]))
        wait_until(lambda: supply.rig.number > before and newest(supply).cameras.names == CAMERAS.names[:5])
        counts = supply.camera_counts()
        assert all(c["connects"] == 1 and c["up"] for c in counts.values()) and "c5" not in counts
        assert counts["c0"]["used"] >= 1000 > counts["c1"]["used"], "what was counted goes on, too"
        supply._workers["c0"].counts["replaced"] += 2000
        supply._aligner.counts["c0"]["replaced"] += 5000
        assert supply.camera_counts()["c0"]["replaced"] >= 7000, "by the camera's thread, and by the rig's"
        assert supply.read(supply.span.first - 1) is not None and supply.span.first > 0, "of the other rig"


def test_a_rig_outlives_files_that_are_being_replaced(rig, caplog, monkeypatch):
    supply = RigFileSource(rig, align=False)

    def vanish(*_):
        raise FileNotFoundError("images.bin has just been moved")

    monkeypatch.setattr("viewmend.contrib.live_rig.rig_source.read_rig", vanish)
    supply._stamp = None
    supply._reload_if_changed()
    assert "the rig stays as it was: images.bin has just been moved" in caplog.text


def test_a_camera_that_was_replaced_delivers_nothing_more(rig):
    """Its last image may be masked while the rig changes; the new calibration is not that image's."""
    supply = RigFileSource(rig, align=False)
    before = supply._workers["c0"]
    rig.write_text(rig_text().replace('video/c0.mp4"', 'video/c0.mp4"\noffset_ms = 5'))
    supply._switch_to(read_rig(rig))
    after = supply._workers["c0"]
    assert after is not before
    images = CameraImages(np.zeros((48, 48, 3), np.uint8), np.zeros((48, 48), np.uint8), depth=None)
    taken_s = time.monotonic()
    supply._add_image(before, taken_s, images)
    assert supply._aligner.take(taken_s + 60) == []
    supply._add_image(after, taken_s, images)
    assert len(supply._aligner.take(taken_s + 60)) == 1


def test_the_default_tolerance_is_half_an_interval_of_the_rate_in_use(rig):
    """The rig's file says 10 fps; at 5 fps, no image is farther than 0.1 s from its tick."""
    supply = RigFileSource(rig, fps=5.0, align=False)
    images = CameraImages(np.zeros((48, 48, 3), np.uint8), np.zeros((48, 48), np.uint8), depth=None)
    start_s = time.monotonic() - 10
    supply._add_image(supply._workers["c0"], start_s, images)
    supply._add_image(supply._workers["c1"], start_s + 0.09, images)
    assert supply._aligner.counts["c1"]["misaligned"] == 0
    [group] = supply._aligner.take(start_s + 60)
    assert set(group.by_camera) == {"c0", "c1"}


def test_a_slow_rig_waits_longer_for_a_stream(rig, monkeypatch):
    timeouts_s = []

    def refuse(*_, timeout, **__):
        timeouts_s.append(timeout)
        raise ValueError("nobody there")

    supplies = [RigFileSource(rig, fps=fps, align=False) for fps in (15.0, 0.5, 0.1)]
    monkeypatch.setattr("av.open", refuse)
    for supply in supplies:
        camera = replace(supply._workers["c0"].camera, url="rtsp://127.0.0.1/a")
        worker = supply._make_worker(camera)
        with pytest.raises(OSError, match="nobody there"):
            next(worker._connect(worker))
    assert timeouts_s == [(5.0, 1.0), (5.0, 5.0), (25.0, 25.0)]


def group_of(names):
    """The images that these cameras took at one time."""
    seen = photograph(CAMERAS.select(names))
    images = [
        CameraImages(rgb.movedim(0, -1).numpy(), mask.numpy(), depth=None)
        for rgb, mask in zip(seen.rgb, seen.mask, strict=True)
    ]
    return ImageGroup(0.0, {name: TimedImages(0.0, one) for name, one in zip(names, images, strict=True)})


@pytest.fixture
def begun(rig):
    """A rig that has begun, whose cameras were not started."""
    supply = RigFileSource(rig, align=False, match_colours=False, tighten_masks=False)
    supply._new_workers = []
    supply._begin_rig()
    return supply


def test_a_rig_has_all_cameras_though_its_first_frame_lacks_some(begun):
    begun._first_frame_deadline_s = 0.0
    begun._add_group(group_of(CAMERAS.names[1:]))
    assert newest(begun).cameras.names == CAMERAS.names[1:] and begun.rig.cameras.names == CAMERAS.names


def test_a_frame_has_two_usable_cameras(begun):
    begun._add_group(group_of(CAMERAS.names))
    begun._prepared = replace(begun._prepared, left_out=CAMERAS.names[:2])
    begun._add_group(group_of(CAMERAS.names[1:3]))
    assert begun.span.end == 1 and begun.status.state == "failing"
    assert "at least two usable cameras, got 1" in begun.status.error
    begun._add_group(group_of(CAMERAS.names[1:4]))
    assert begun.span.end == 2 and begun.status.state == "ready"


def test_a_rig_says_why_its_connected_cameras_make_no_frame(begun):
    now_s = time.monotonic()
    begun._check_cameras(now_s)
    assert "expected at least two cameras, got 0; 'c0': silent" in begun.status.error
    for worker in begun._workers.values():
        worker.up = True
    begun._check_cameras(now_s + 1)
    assert "'c0': silent" in begun.status.error, "images may be on their way"
    begun._check_cameras(now_s + 10)
    assert "got none; check clock and offset_ms" in begun.status.error
    begun._workers["c1"].error = "expected images of 48 x 48 pixels"
    begun._check_cameras(now_s + 11)
    assert "'c1': expected images of 48 x 48 pixels" in begun.status.error
    begun._add_group(group_of(CAMERAS.names))
    begun._check_cameras(time.monotonic())
    assert begun.status.state == "ready" and begun.status.error is None


def test_recordings_that_do_not_overlap_are_an_error_of_the_rig(rig, monkeypatch):
    def apart(_):
        raise ValueError("expected recordings that overlap in time, got none")

    monkeypatch.setattr("viewmend.contrib.live_rig.frame_readers.match_tracks", apart)
    with pytest.raises(CaptureError, match="overlap in time"):
        RigFileSource(rig)


def test_a_rig_says_that_it_waits_for_its_cameras(rig):
    supply = RigFileSource(rig, align=False)
    with reading(supply):
        assert supply.status.error == "waiting for the cameras" or supply.status.state == "ready"
        wait_until(lambda: supply.status.state == "ready")
        assert supply.status.error is None


def test_what_was_lost_since_the_last_line_is_said_and_no_more(rig, caplog, monkeypatch):
    caplog.set_level(logging.WARNING)
    supply = RigFileSource(rig, align=False)
    for late, torn in ((3, 0), (5, 1), (5, 1), (0, 0), (1, 0)):  # then the camera was opened anew
        told = {"c0": {"late": late, "torn": torn, "used": 90}, "c1": {"used": 90}}
        monkeypatch.setattr(supply, "camera_counts", lambda told=told: told)
        supply._report_losses()
    said = [message.split(": ", 1)[1] for message in caplog.messages]
    assert said == ["c0 3 late", "c0 2 late, 1 torn", "c0 1 late"]


def test_what_is_wrong_is_said_once_until_something_else_is(rig, caplog):
    caplog.set_level(logging.WARNING)
    supply, told = RigFileSource(rig, align=False), []
    supply.changed = lambda: told.append(supply.status.error)
    for error in ("no light", "no light", "no power"):
        supply._set_error(error)
    assert caplog.messages == ["no light", "no power"], "on the terminal"
    assert told == ["no light", "no light", "no power"] and supply.status.state == "failing"


def test_a_camera_that_is_gone_is_missed_and_comes_back(rig):
    supply = RigFileSource(rig, align=False)
    worker, unplugged = supply._workers["c2"], threading.Event()
    connect = worker._connect

    def through_a_plug(worker):
        with closing(connect(worker)) as pictures:
            for picture in pictures:
                if unplugged.is_set():
                    raise OSError("unplugged")
                yield picture

    worker._connect = through_a_plug
    with reading(supply):
        wait_until(lambda: of_all(supply) is not None)
        unplugged.set()
        wait_until(lambda: newest(supply).cameras.names == tuple(n for n in CAMERAS.names if n != "c2"))
        wait_until(lambda: worker.error == "unplugged")
        assert supply.status.state == "ready", "the others go on"
        unplugged.clear()
        wait_until(lambda: "c2" in newest(supply).cameras.names)
        assert worker.counts["connects"] == 2


def test_without_a_subject_the_background_is_shown(rig):
    supply, gone = RigFileSource(rig, align=False), threading.Event()
    add_group = supply._add_group

    def add_with_or_without(group):
        if gone.is_set():
            for name, taken in group.by_camera.items():
                images = replace(taken.images, mask=np.zeros_like(taken.images.mask))
                group.by_camera[name] = replace(taken, images=images)
        add_group(group)

    supply._add_group = add_with_or_without
    with reading(supply):
        wait_until(lambda: of_all(supply) is not None)
        gone.set()
        wait_until(lambda: not newest(supply).has_subject)
        assert supply.status.state == "ready"
        gone.clear()
        wait_until(lambda: newest(supply).has_subject)


def test_a_rig_that_cannot_be_is_one_line_before_any_address(rig, capsys):
    (rig.parent / "take/video/c3.mp4").unlink()
    assert main(["serve", str(rig), "--port", "0"]) == 2
    said = capsys.readouterr().err
    assert "camera 'c3': expected a video, got: No such file or directory" in said and said.count("\n") == 1
    with pytest.raises(CaptureError, match="expected a rig's TOML file"):
        RigFileSource(rig.parent / "none.toml")
