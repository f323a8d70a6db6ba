"""One process reads, others render: what each of them is told and given, here in one process, but through pickles."""

import threading
import time

import pytest
import torch
from live_servers import CAMERAS, PIPELINE, wait_until
from reference.ball import BallCapture
from test_shared_time import passed_on

from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.inpainting.protocol import RenderQuality
from viewmend.live import shared_time
from viewmend.live.frames import ReadAhead
from viewmend.live.ingest import Ingest
from viewmend.live.poses import view_camera
from viewmend.live.protocol import Camera
from viewmend.live.pushed import PushedFrames
from viewmend.live.renderer import Renderer, RenderRequest
from viewmend.live.shared_frames import SharedFrames

FRAMES = 5


class Link:
    """To an ingest that may be away, and replaced; counts what is asked for."""

    def __init__(self, ingest):
        self.ingest, self.asked = ingest, []

    def state(self, known, wait_s, watched):
        self._demand()
        return self.ingest.state(known, min(wait_s, 0.2), watched)

    def time(self, at, wait_s):
        self._demand()
        self.asked.append(at)
        found = self.ingest.time(at, min(wait_s, 0.2))
        return None if found is None else (found[0], passed_on(found[1])[0])

    def _demand(self):
        if self.ingest is None:
            raise ConnectionError("it is away")


def recording():
    return ReadAhead(lambda: BallCapture(CAMERAS, FRAMES), memory_mb=50.0)


def ingest_of(supply, memory_mb=50.0):
    return Ingest(supply, SmoothFill(), PIPELINE.hull, memory_mb)


@pytest.fixture
def link():
    """To a recording whose edge stands still at 0."""
    supply = recording()
    supply.recording.playing = False
    yield Link(ingest_of(supply))
    supply.stop()


@pytest.fixture
def follow():
    """Starts followers of a link, and ends them."""
    begun = []

    def start(link, memory_mb=50.0):
        frames = SharedFrames(link, memory_mb)
        frames.start()
        begun.append(frames)
        wait_until(lambda: frames.rig is not None)
        return frames

    yield start
    for frames in begun:
        frames.stop()


def fetched(frames, at):
    wait_until(lambda: frames.read(at) is not None)
    return frames.read(at)


def test_all_who_follow_see_what_was_made_once(link, follow, monkeypatch):
    carved = []
    observe = shared_time.observe
    monkeypatch.setattr(shared_time, "observe", lambda *given: carved.append(given[0].time) or observe(*given))
    one, other = follow(link), follow(link)
    assert torch.equal(fetched(one, 2).rgb, fetched(other, 2).rgb)
    assert one.span == other.span and one.span.end == FRAMES and one.rig.name == other.rig.name
    wait_until(lambda: 3 in one._kept and 3 in other._kept)
    assert sorted(carved) == [2, 3], "each once, and one ahead"
    made = one.made(2)
    assert made.depths.keys() == set(CAMERAS.names) and len(made.proxy.mesh.vertices) > 100


def test_no_more_than_the_next_time_is_fetched_ahead(link, follow):
    frames = follow(link)
    fetched(frames, FRAMES - 1)
    wait_until(lambda: 0 in frames._kept)  # over and over: after the last comes the first
    time.sleep(0.3)
    assert link.asked == [FRAMES - 1, 0]


def test_a_replica_renders_the_same_pixels(link, follow):
    alone = recording()
    alone.start()
    pictures = []
    for supply in (alone, follow(link)):
        fetched(supply, 1)
        renderer = Renderer(supply, SmoothFill(), PIPELINE)
        assert renderer.prepare(1)
        camera = view_camera(Camera(azimuth=33.0), renderer.frame, (64, 64))
        fetched(supply, 2)  # another one, which was not looked at to prepare
        result = renderer.render(RenderRequest(2, (camera,), RenderQuality()), None)
        pictures.append((result.completed[0].rgb, result.times.geometry, renderer.rig_json))
    alone.stop()
    assert torch.equal(pictures[0][0], pictures[1][0]) and pictures[0][0].any()
    assert pictures[0][2] == pictures[1][2]
    assert pictures[1][1] == 0 < pictures[0][1], "the hull is the ingest's work"


def test_an_ingest_that_ends_is_said_and_its_successor_followed(link, follow):
    frames = follow(link)
    fetched(frames, 2)
    first, link.ingest = frames.rig, None
    wait_until(lambda: frames.status.state == "failing")
    assert "is started again" in frames.status.error
    assert frames.read(2) is not None, "what is here can be shown meanwhile"
    supply = recording()
    link.ingest = ingest_of(supply)
    wait_until(lambda: frames.rig is not first)
    assert frames.rig.number == first.number, "its times are others, whatever their numbers"
    fetched(frames, 2)
    wait_until(lambda: frames.status.state == "ready")
    supply.stop()


def test_a_time_of_a_rig_that_has_gone_is_not_kept(link, follow):
    frames = follow(link)
    with frames._lock:
        frames._keep(2, ("another", link.ingest.time(2, 5.0)[1]))
    assert 2 not in frames._kept


def test_a_new_rig_is_another(follow):
    pushed = PushedFrames()
    link = Link(ingest_of(pushed))
    frame = BallCapture(CAMERAS, 1).read(0)
    pushed.begin("one", 15.0, None, None)
    pushed.push(frame)
    frames = follow(link)
    assert fetched(frames, 0) is not None and frames.span.live
    before = frames.rig
    pushed.begin("two", 15.0, None, None)
    pushed.push(frame)
    wait_until(lambda: frames.rig.name == "two")
    assert frames.rig is not before and frames.read(0) is None
    assert fetched(frames, 1).time == 1
    wait_until(lambda: frames.span.end == 2)
    same = frames.rig
    pushed.push(frame)
    wait_until(lambda: frames.span.end == 3)
    assert frames.rig is same, "nobody prepares anew for a frame"


def test_all_who_follow_the_edge_see_the_same_times_however_slow_the_hull(follow, monkeypatch):
    carved = []
    observe = shared_time.observe

    def slowly(*given):
        time.sleep(0.2)  # six frames
        carved.append(given[0].time)
        return observe(*given)

    monkeypatch.setattr(shared_time, "observe", slowly)
    supply = ReadAhead(lambda: BallCapture(CAMERAS, 1000), fps=30.0)
    link = Link(ingest_of(supply))
    seen = [set(), set()]
    followers = [follow(link), follow(link)]
    end = time.monotonic() + 4
    while time.monotonic() < end or (len(seen[0] & seen[1]) < 6 and time.monotonic() < end + 26):  # on a busy machine
        for frames, times in zip(followers, seen, strict=True):
            at = int(frames.recording.position)
            if frames.read(at) is not None:
                times.add(at)
        time.sleep(0.004)
    supply.stop()
    assert len(seen[0] & seen[1]) >= 6, "times come, though each is late"
    assert len(seen[0] ^ seen[1]) <= 2
    assert len(carved) <= len(seen[0] | seen[1]) + 6, "the first ones pass until it is known how slow it is"
    assert max(seen[0]) - min(seen[0]) > 45, "and the edge goes on as fast as ever"


def test_while_nobody_watches_nothing_is_made(link, follow):
    link.ingest._supply.recording.playing = True
    frames = follow(link)
    wait_until(lambda: frames.recording.position > 0, 5)  # the edge goes on
    time.sleep(0.3)
    assert link.asked == [] and not link.ingest._kept


def test_of_a_live_rig_nobody_sees_what_is_not_made(follow, monkeypatch):
    pushed = PushedFrames()
    link = Link(ingest_of(pushed))
    pushed.begin("one", 15.0, None, None)
    frame = BallCapture(CAMERAS, 1).read(0)
    pushed.push(frame)
    frames = follow(link)
    fetched(frames, 0)
    wait_until(lambda: link.ingest._led == 0)
    may_carve, observe = threading.Event(), shared_time.observe
    monkeypatch.setattr(shared_time, "observe", lambda *given: may_carve.wait(20) and observe(*given))
    pushed.push(frame)
    for _ in range(20):
        assert frames.read(0) is not None and frames.span.newest == 0
        time.sleep(0.02)
    may_carve.set()
    wait_until(lambda: frames.read(frames.span.newest) is not None and frames.span.newest == 1)


def test_what_is_kept_is_bounded(follow):
    supply = recording()
    ingest = ingest_of(supply, memory_mb=0.001)
    link = Link(ingest)
    frames = follow(link, memory_mb=0.001)
    for at in range(FRAMES):
        fetched(frames, at)
        assert len(ingest._kept) == 1 and len(frames._kept) <= 2
    supply.stop()


def test_who_waits_for_a_time_does_not_keep_others_from_one_that_is_there(link):
    wait_until(lambda: link.ingest.time(0, 1.0) is not None)
    waiting = threading.Thread(target=link.ingest.time, args=(FRAMES + 7, 2.0))
    waiting.start()
    start = time.monotonic()
    assert link.ingest.time(0, 1.0) is not None and time.monotonic() - start < 1.0
    waiting.join()
