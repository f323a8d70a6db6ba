"""The page and the command render the same pixels of a real capture, whose calibration needs alignment."""

import contextlib
import json

import cv2
import numpy as np
import pytest
import torch
from live.live_servers import wait_until

from viewmend.cli import main, serve
from viewmend.cli.checks import PreparationOptions
from viewmend.live.encoding import draw_mode
from viewmend.live.frame_source import Span
from viewmend.live.protocol import Camera, Look
from viewmend.live.renderer import FrameNotReadyError, Renderer
from viewmend.live.sessions import PlaybackState, ViewerSession
from viewmend.models.registry import error_model_for, make_method

SIZE_PX = (480, 360)


def resting_request(renderer):
    """The request of a viewer whose page has drawn the moving view and now waits for the completed one."""
    session = ViewerSession(lambda message: None, lambda error: None, 100.0, renderer.ladder, lambda: 0.0)
    camera = Camera(azimuth=renderer.home.azimuth + 25)
    session.look(Look(camera=camera, width=SIZE_PX[0], height=SIZE_PX[1], full=True))
    playback = PlaybackState(Span(0, 1, 1), 0.0, renderer.home, lambda index: True, active_viewers=1)
    return session.next_request(0.0, playback)


def served(capture, model, align=True):
    """A view of the first frame as `viewmend serve` renders it at rest, and its camera."""
    source = serve.open_source(
        serve.Options(source=str(capture), preparation=PreparationOptions(align=align))
    )
    source.start()
    try:
        inpainter = make_method(model)
        renderer = Renderer(source, inpainter, error_model=error_model_for(inpainter))

        def prepare():
            with contextlib.suppress(FrameNotReadyError):
                return renderer.prepare(0)

        wait_until(prepare)
        request = resting_request(renderer)
        result = renderer.render(request, None)
        assert renderer.model_error is None
        return draw_mode(result.completed[0], "completed", result.background), request.cameras[0]
    finally:
        source.stop()


@pytest.fixture
def eight_cameras(shared, tmp_path):
    """The real capture wd2 with eight of its twenty cameras."""
    original = shared / "captures/wd2"
    capture = tmp_path / "wd2"
    capture.mkdir()
    for folder in ("images", "masks"):
        (capture / folder).symlink_to(original / folder)
    content = json.loads((original / "cameras.json").read_text())
    content["cameras"] = content["cameras"][:16:2]
    (capture / "cameras.json").write_text(json.dumps(content))
    return capture


def compare_pixels(capture, model, tmp_path):
    """Compare a view on the page with the view that the command writes of the same pose; returns the page's."""
    page, camera = served(capture, model)
    pose = torch.linalg.inv(camera.camera_from_world[0])
    path = {
        "world_from_camera": [pose.tolist()],
        "K": camera.K[0].tolist(),
        "width": SIZE_PX[0],
        "height": SIZE_PX[1],
    }
    (tmp_path / "path.json").write_text(json.dumps(path))
    options = [
        "--path",
        tmp_path / "path.json",
        "--frames",
        "0:1",
        "--model",
        model,
        "--out",
        tmp_path / "out",
    ]
    assert main(["mend", str(capture), *map(str, options)]) == 0
    (written,) = (tmp_path / "out/completed").glob("*.png")
    command = cv2.imread(str(written))[..., ::-1]
    assert command.shape == (360, 480, 3) and (command != command[0, 0]).any(2).mean() > 0.05
    off = np.abs(command.astype(int) - page.astype(int)).max(2)
    assert (off > 1).mean() < 2e-4, (
        "a pose in JSON is rounded, and an edge may fall to the other side of a pixel"
    )
    return page


@pytest.mark.slow
def test_serve_and_mend_show_the_same_pixels_of_all_cameras(shared, tmp_path):
    compare_pixels(shared / "captures/wd2", "rays", tmp_path)


@pytest.mark.slow
def test_serve_and_mend_predict_the_same_mask(eight_cameras, tmp_path):
    compare_pixels(eight_cameras, "paper-small", tmp_path)


@pytest.mark.slow
def test_serve_and_mend_show_the_same_pixels(eight_cameras, tmp_path):
    page = compare_pixels(eight_cameras, "telea", tmp_path)
    unaligned, _ = served(eight_cameras, "telea", align=False)
    off = np.abs(unaligned.astype(int) - page.astype(int)).max(2)
    assert (off > 1).mean() > 0.01, "the alignment shows"
