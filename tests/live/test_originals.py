"""What the page asks for beside views: cameras' own images, a film's progress, another background."""

import json

import numpy as np
import pytest
from live_servers import running
from test_server import decoded, get

from viewmend.live.pictures import picture
from viewmend.live.protocol import Limits
from viewmend.live.render_jobs import PathJob, parse_path


@pytest.fixture(scope="module")
def served():
    with running() as server:
        yield server


def test_a_cameras_image_is_what_it_took(served):
    name = served.service.renderer.rig_json["cameras"][1]["name"]
    status, headers, body = get(f"{served.url}/camera.jpg?name={name}&time=2")
    assert status == 200 and headers["content-type"] == "image/jpeg" and headers["x-viewmend-time"] == "2"
    frame = served.service.supply.read(2)  # it is there now
    taken = frame.select([name]).rgb[0].movedim(0, -1).numpy()
    assert decoded(body).shape == taken.shape and np.abs(decoded(body) - taken.astype(int)).mean() < 4
    assert get(f"{served.url}/camera.jpg?name={name}&time=99999")[0] == 200, "the nearest time that there is"


@pytest.mark.parametrize("query", ["", "name=nobody", "name=nobody&time=x", "name=nobody&size=3", "name=" + 99 * "a"])
def test_an_image_that_is_not_there_is_refused(served, query):
    status, _, body = get(f"{served.url}/camera.jpg?{query}")
    assert status == 400 and "expected" in json.loads(body)["error"]


def test_a_film_tells_how_far_it_is(served):
    pytest.importorskip("av")
    assert json.loads(get(f"{served.url}/path")[2]) == {"done": None, "of": None}
    job = PathJob(parse_path(b'{"poses": [{}, {}, {}], "width": 32, "height": 32}', Limits()))
    assert job.progress == (0, 3)
    served.live._film = job
    assert json.loads(get(f"{served.url}/path")[2]) == {"done": 0, "of": 3}
    served.live._film = None
    body = json.dumps({"poses": [{}, {}], "width": 32, "height": 32}).encode()
    assert get(f"{served.url}/path.mp4", data=body)[0] == 200
    assert json.loads(get(f"{served.url}/path")[2]) == {"done": None, "of": None}, "it is over"


@pytest.mark.parametrize("mode", ["mended", "rendered", "holes", "depth", "coverage", "confidence"])
def test_a_picture_lies_upon_the_background(ball_view, mode):
    black, blue = picture(ball_view, mode), picture(ball_view, mode, "0040ff")
    bare, solid = ball_view.view.mask == 0, ball_view.opacity == 1
    assert bool(bare.any()) and (blue[bare.numpy()] == (0, 0x40, 0xFF)).all()
    assert (blue[solid.numpy()] == black[solid.numpy()]).all() and bool(solid.any())


def test_a_background_that_is_no_colour_is_refused(served):
    for colour in ("red", "00ff0", "00FF00", "00ff00%0A"):
        assert get(f"{served.url}/frame.jpg?width=32&height=32&background={colour}")[0] == 400
    _, _, body = get(f"{served.url}/frame.jpg?width=64&height=64&background=00ff00")
    assert np.abs(decoded(body)[:4, :4].astype(int) - (0, 255, 0)).max() < 12
