"""Where a sender's clock is."""

from viewmend.contrib.live_rig.frame_readers import SenderClock

FRAME_S = 1 / 15


def test_before_any_packet_nothing_is_known():
    assert SenderClock().here_s(3.0) is None


def test_delays_do_not_move_a_picture():
    clock = SenderClock()
    for n in range(100):
        delay_s = 0.02 + (0.3 if n % 7 else 0.0)
        clock.saw(500 + n * FRAME_S, 7 + n * FRAME_S + delay_s)
        if n:
            assert abs(clock.here_s(500 + n * FRAME_S) - (7 + n * FRAME_S + 0.02)) < 1e-9


def test_a_clock_that_runs_wrong_is_followed():
    clock, ppm = SenderClock(), 200e-6
    for n in range(15 * 600):
        at_s = n * FRAME_S
        clock.saw(at_s * (1 + ppm), at_s + 0.01)
    assert abs(clock.here_s(at_s * (1 + ppm)) - (at_s + 0.01)) < 0.003  # of a drift of 120 ms


def test_a_sender_that_begins_anew_is_found_at_once():
    for restart_s in (0.0, 9000.0):
        clock = SenderClock()
        for n in range(30):
            clock.saw(100 + n * FRAME_S, n * FRAME_S)
        clock.saw(restart_s, 5.0)
        assert clock.here_s(restart_s) == 5.0


def test_a_stall_of_the_network_is_no_new_beginning():
    clock = SenderClock()
    for n in range(30):
        clock.saw(n * FRAME_S, n * FRAME_S)
    clock.saw(30 * FRAME_S, 30 * FRAME_S + 3.0)
    assert abs(clock.here_s(30 * FRAME_S) - 30 * FRAME_S) < 1e-9
