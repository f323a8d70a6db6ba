from viewmend.live.clock import Clock, Span, edge_of
from viewmend.live.protocol import ClockChange

RECORDING = Span(0, 30, 30, 10.0)
LIVE = Span(5, 50, None, 10.0, live=True)


def parted(**change) -> Clock:
    clock = Clock()
    clock.change(ClockChange(**change), RECORDING)
    return clock


def test_a_recording_begins_anew():
    clock = parted(seek=0)
    times = []
    for _ in range(70):
        clock.advance(0.05, RECORDING, 3.0)
        times.append(clock.time(RECORDING))
    assert times[:4] == [0, 1, 1, 2] and max(times) == 29 and times[-1] == 5


def test_a_recording_that_is_being_made_waits_at_its_end():
    clock, growing = parted(seek=0), Span(0, 3, 30, 10.0)
    clock.advance(5.0, growing)
    assert clock.time(growing) == 2 and not growing.complete
    clock.advance(0.1, Span(0, 10, 30, 10.0))
    assert clock.time(Span(0, 10, 30, 10.0)) == 3


def test_followers_are_at_the_edge_and_part_from_it():
    clock = Clock()
    clock.advance(0.1, RECORDING, 17.3)
    assert clock.time(RECORDING) == 17
    clock.change(ClockChange(playing=False), RECORDING)
    clock.advance(9.0, RECORDING, 25.0)
    assert clock.time(RECORDING) == 17 and not clock.live
    clock.change(ClockChange(playing=True), RECORDING)
    clock.advance(0.2, RECORDING, 25.0)
    assert clock.time(RECORDING) == 19
    clock.change(ClockChange(live=True), RECORDING)
    clock.advance(0.2, RECORDING, 25.0)
    assert clock.time(RECORDING) == 25


def test_speed_and_seek():
    clock = parted(speed=2.0)
    assert not clock.live
    clock.advance(1.0, RECORDING, 3.0)
    assert clock.time(RECORDING) == 20
    assert parted(speed=1.0).live
    assert parted(seek=999).time(RECORDING) == 29 and parted(seek=-5).time(RECORDING) == 0


def test_a_live_rig_ends_at_its_newest_frame_and_forgets():
    clock = Clock()
    assert edge_of(LIVE, clock) == 49.0
    clock.change(ClockChange(seek=0), LIVE)
    assert clock.time(LIVE) == 5
    clock.advance(100.0, LIVE, 49.0)
    assert clock.time(LIVE) == 49


def test_before_the_first_frame_there_is_no_time():
    clock = Clock()
    clock.advance(1.0, Span(), 0.0)
    assert clock.time(Span()) == -1
    single = Span(0, 1, 1, 0.0)
    clock.change(ClockChange(seek=0), single)
    clock.advance(100.0, single)
    assert clock.time(single) == 0
