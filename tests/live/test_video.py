"""Video streams are encoded without delay; their size may change at any time."""

import json

import av
import numpy as np
import pytest
from live.live_servers import WAIT_S, open_websocket, running, say_hello

from viewmend.live.protocol import unpack
from viewmend.live.video import ENCODERS, STRINGS, VideoStream, video_codecs

CODECS = [
    pytest.param(c, marks=pytest.mark.skipif(c not in video_codecs(), reason=f"no {c} here"))
    for c in ENCODERS
]


def image(step: int, width: int = 64, height: int = 48):
    """A bright square that moves over a gradient."""
    rows, columns = np.mgrid[:height, :width]
    picture = np.stack([rows * 2, columns * 2, 0 * rows + 60], -1).astype(np.uint8)
    picture[10:30, 5 + step : 25 + step] = (240, 200, 40)
    return picture


class Decoder:
    """Decodes like the page."""

    def __init__(self, codec):
        self.context = av.CodecContext.create("vp9" if codec == "vp9" else "h264", "r")

    def decode(self, data):
        (frame,) = [*self.context.decode(av.Packet(data)), *self.context.decode(None)][:1]
        self.context.flush_buffers()
        return frame.to_ndarray(format="rgb24")


@pytest.mark.parametrize("codec", CODECS)
def test_every_frame_is_encoded_at_once(codec):
    stream = VideoStream()
    chunks = [stream.encode(image(step), codec, key=False) for step in range(6)]
    assert [key for _, key in chunks] == [True] + 5 * [False]
    assert len(chunks[3][0]) < 0.6 * len(chunks[0][0])
    context = av.CodecContext.create("vp9" if codec == "vp9" else "h264", "r")
    frames = [f for data, _ in chunks for f in context.decode(av.Packet(data))] + list(context.decode(None))
    assert len(frames) == 6
    for step, frame in enumerate(frames):
        assert np.abs(frame.to_ndarray(format="rgb24").astype(int) - image(step)).mean() < 9


@pytest.mark.parametrize("codec", CODECS)
def test_key_frames_on_request_and_after_a_change_of_size(codec):
    stream = VideoStream()
    stream.encode(image(0), codec, key=False)
    assert not stream.encode(image(1), codec, key=False)[1]
    assert stream.encode(image(2), codec, key=True)[1]
    data, key = stream.encode(image(3, 33, 47), codec, key=False)
    assert key and Decoder(codec).decode(data).shape == (48, 34, 3)


def next_frame(viewer):
    while True:
        message = viewer.recv(timeout=WAIT_S)
        if isinstance(message, bytes):
            header, parts = unpack(message)
            viewer.send(json.dumps({"type": "ack", "frame": header["frame"]}))
            return header, parts
        assert json.loads(message)["type"] != "error", message


def test_a_viewer_chooses_a_codec():
    with running() as server, open_websocket(server) as viewer:
        assert say_hello(viewer, ["vp9", "h264", "av1"])["codecs"] == ["jpeg", *video_codecs()]
        viewer.send(json.dumps({"type": "clock", "playing": False}))
        for codec in (*video_codecs(), "jpeg"):
            keys = []
            for key in (False, False, True):
                look = {
                    "type": "look",
                    "codec": codec,
                    "width": 48,
                    "height": 48,
                    "modes": ["rendered", "completed"],
                }
                viewer.send(json.dumps(look | {"key": key}))
                header, parts = next_frame(viewer)
                assert [part["codec"] for part in header["parts"]] == [codec, codec]
                keys.append(header["parts"][1].get("key"))
            assert keys == ([None] * 3 if codec == "jpeg" else [True, False, True])
            if codec != "jpeg":
                assert header["parts"][0]["codec_string"] == STRINGS[codec]
                assert Decoder(codec).decode(parts[1]).shape == (48, 48, 3)


def test_a_codec_that_is_not_available_is_refused(ball, monkeypatch):
    monkeypatch.setitem(ball.live.registry.about, "codecs", ["jpeg"])
    with open_websocket(ball) as viewer:
        assert say_hello(viewer)["codecs"] == ["jpeg"]
        viewer.send(json.dumps({"type": "look", "codec": "vp9"}))
        while (note := json.loads(viewer.recv(timeout=WAIT_S)))["type"] != "error":
            pass
        assert "expected a codec among ['jpeg'], got 'vp9'" in note["message"]
