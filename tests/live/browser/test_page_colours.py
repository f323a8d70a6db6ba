"""Colours of videos in a browser are those that were encoded, whatever their size."""

import base64

import numpy as np
import pytest

from viewmend.data.videos import write_mp4, write_webm
from viewmend.live.video import ENCODERS, STRINGS, VideoStream, video_codecs

pytestmark = pytest.mark.slow

COLOURS = np.array(
    [(200, 40, 40), (40, 200, 40), (40, 40, 200), (220, 180, 150), (128, 128, 128), (250, 250, 250)]
)
SIZES = [(384, 240), (1280, 720)]
PAINT = """
const paint = (shown, width, height) => {
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  const context = canvas.getContext("2d");
  context.drawImage(shown, 0, 0);
  const at = (n) => context.getImageData((n + 0.5) * width / 6, height / 2, 1, 1).data;
  return [...Array(6).keys()].map((n) => [...at(n)].slice(0, 3));
};
const bytes = Uint8Array.from(atob(data), (sign) => sign.charCodeAt(0));
"""
FILM = f"""async ([data, type]) => {{ {PAINT}
  const src = URL.createObjectURL(new Blob([bytes], {{ type }}));
  const video = Object.assign(document.createElement("video"), {{ muted: true, src }});
  const first = new Promise((done) => video.requestVideoFrameCallback(done));
  await video.play();
  await first;
  return paint(video, video.videoWidth, video.videoHeight);
}}"""
CHUNK = f"""async ([data, codec, width, height]) => {{ {PAINT}
  return new Promise((output, error) => {{
    const decoder = new VideoDecoder({{ output: (frame) => output(paint(frame, width, height)), error }});
    decoder.configure({{ codec, optimizeForLatency: true }});
    decoder.decode(new EncodedVideoChunk({{ type: "key", timestamp: 0, data: bytes }}));
    void decoder.flush();
  }});
}}"""


def bars(width, height):
    return np.repeat(np.repeat(COLOURS.astype(np.uint8)[None], width // 6, 1), height, 0)


@pytest.fixture
def page(browser, server):
    one = browser.new_page()
    one.goto(f"{server.url}health")  # a place from which WebCodecs may be used
    yield one
    one.close()


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", ["mp4", "webm"])
def test_films_keep_their_colours(page, tmp_path, size, kind):
    picture, path = bars(*size), tmp_path / f"film.{kind}"
    if kind == "mp4":
        write_mp4(path, [picture] * 3, 10.0)
    else:
        opaque = np.full((*picture.shape[:2], 1), 255, np.uint8)
        write_webm(path, [np.concatenate([picture, opaque], 2)] * 3, 10.0)
    shown = page.evaluate(FILM, [base64.b64encode(path.read_bytes()).decode(), f"video/{kind}"])
    assert np.abs(np.array(shown) - COLOURS).max() <= 4


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("codec", ENCODERS)
def test_streams_keep_their_colours(page, size, codec):
    if codec not in video_codecs():
        pytest.skip(f"no {codec} here")
    picture = bars(*size)
    data, _ = VideoStream().encode(picture, codec, key=True)
    height, width = picture.shape[:2]
    shown = page.evaluate(CHUNK, [base64.b64encode(data).decode(), STRINGS[codec], width, height])
    assert np.abs(np.array(shown) - COLOURS).max() <= 4
