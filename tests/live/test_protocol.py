"""Messages are parsed strictly, and packed and unpacked."""

import json
import struct

import pytest

from viewmend.live import protocol
from viewmend.live.assets import AssetQuery
from viewmend.live.protocol import (
    Ack,
    Camera,
    Cancel,
    ClockChange,
    FrameTimes,
    Hello,
    Limits,
    Look,
    ProtocolError,
)
from viewmend.live.render_jobs import ImageQuery, SourceImageQuery

LIMITS = Limits()


def said(**message):
    return protocol.parse(json.dumps(message), LIMITS)


def test_every_message_is_parsed():
    assert said(type="hello", version=1, codecs=["h264", "theora", "jpeg"]) == Hello(
        1, ("h264", "theora", "jpeg")
    )
    assert said(type="ack", frame=3) == Ack(3)
    assert said(type="cancel") == Cancel()
    assert said(type="ping", sent_ms=1.5) == protocol.Ping(1.5)
    assert said(type="clock", seek=4, speed=2) == ClockChange(None, 2.0, 4, False)
    assert said(type="clock", playing=False, live=True) == ClockChange(False, None, None, True)
    assert said(type="look") == Look()
    look = said(
        type="look",
        id=7,
        camera={"azimuth": 20, "target": [1, 2, 3]},
        modes=["holes", "completed"],
        top_k=None,
    )
    assert look.cameras == (Camera(azimuth=20.0, target=(1.0, 2.0, 3.0)),) and look.modes == (
        "holes",
        "completed",
    )
    two = said(type="look", eyes=[{"fx": 100}, {"fx": 100, "cx": 3}])
    assert two.cameras == (Camera(fx=100.0), Camera(fx=100.0, cx=3.0))
    turned = said(type="look", camera={"R": [0, 1, 0, -1, 0, 0, 0, 0, 1], "T": [0, 0, 2], "fov_y": 40})
    assert turned.cameras[0].T == (0.0, 0.0, 2.0) and turned.cameras[0].fov_y == 40


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (
            {"type": "shout"},
            'type: expected hello or look or cancel or ack or clock or on_air or ping, got "shout"',
        ),
        ({"type": "look", "width": 5000}, "from 16 to 2048 pixels, got 5000 x 320"),
        ({"type": "look", "width": 2048, "height": 2048}, "at most 2100000 pixels, got 2048 x 2048"),
        ({"type": "look", "width": 1024, "height": 1100, "eyes": [{}, {}]}, "at most 2100000 pixels"),
        ({"type": "look", "width": 99.5}, "a whole number"),
        (
            {"type": "look", "modes": ["completed", "completet"]},
            'expected rendered or holes or .* or points, got "completet"',
        ),
        ({"type": "look", "error_rule": "some"}, 'error_rule: expected .*, got "some"'),
        ({"type": "look", "modes": []}, "modes: expected a list that is not empty"),
        ({"type": "look", "modes": ["compared"]}, "expected 'model' for the mode 'compared'"),
        (
            {"type": "look", "camera": {"R": [1, 0, 0, 0, 1, 0, 0, 0, -1], "T": [0, 0, 0]}},
            "expected 'R' as a rotation",
        ),
        ({"type": "look", "camera": {"R": [1, 0, 0, 0, 1, 0, 0, 0, 1]}}, "'T'"),
        ({"type": "look", "camera": {"distance": -1}}, "camera: distance: expected a number >= 0.02, got -1"),
        ({"type": "look", "camera": [1]}, "expected an object of keys"),
        ({"type": "look", "moving": 1}, "true or false"),
        ({"type": "ack", "frame": True}, "frame: expected a whole number, got true"),
        ({"type": "clock", "speed": 99}, "speed: expected a number <= 4"),
        ({"type": "hello"}, "version: expected a value, got nothing"),
        ([1, 2], "expected an object of keys"),
    ],
)
def test_errors_name_the_invalid_value(message, words):
    with pytest.raises(ProtocolError, match=words):
        protocol.parse(json.dumps(message), LIMITS)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "NaN",
        '{"type": "ack", "frame": NaN}',
        '{"type":"ping","sent_ms":1e999}',
        "[" * 9000,
        "9" * 9000,
    ],
)
def test_invalid_json_is_refused(text):
    with pytest.raises(ProtocolError):
        protocol.parse(text, LIMITS)


def test_long_messages_and_headers_are_refused():
    with pytest.raises(ProtocolError, match="at most 16384 bytes"):
        protocol.parse(" " * 20_000, LIMITS)
    with pytest.raises(ProtocolError, match="at most 1000000 bytes, got one of 1000001"):
        protocol.unpack(b"VMF1" + struct.pack("<I", 1_000_001) + b" " * 1_000_001, "images")


def test_binary_messages_are_unpacked_as_packed():
    header = {"frame": 3, "parts": [{"kind": "image", "bytes": 2}, {"kind": "depth", "bytes": 0}]}
    message = protocol.pack(header, [b"ab", b""])
    assert protocol.unpack(message) == (header, [b"ab", b""])
    for cut in range(len(message)):
        with pytest.raises(ProtocolError):
            protocol.unpack(message[:cut])
    with pytest.raises(ProtocolError):
        protocol.unpack(message + b"x")


def test_stage_times_are_added_and_averaged():
    times = FrameTimes(rendering=3.0, wait=1.0) + FrameTimes(rendering=5.0, encode=2.0)
    assert times.as_json(2) == {
        "geometry": 0, "context": 0, "rendering": 4, "inpainting": 0, "encode": 1, "wait": 0.5, "total": 5.5
    }  # fmt: skip


def test_cameras_may_have_long_names():
    """As those of calibrations whose names are paths."""
    name = 300 * "c"
    assert said(type="look", without=[name]).without == (name,)
    for kind, query in (
        (ImageQuery, {"camera": name, "without": ",".join(30 * [name])}),
        (SourceImageQuery, {"name": name}),
        (AssetQuery, {"time": "0", "without": ",".join(30 * [name])}),
    ):
        assert protocol.read_message(query, kind, strict=False)


def test_null_means_absent():
    assert said(type="look", top_k=None, width=None, camera={"distance": None}) == Look()
    with pytest.raises(ProtocolError, match="version: expected a value, got nothing"):
        said(type="hello", version=None)
