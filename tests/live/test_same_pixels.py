"""The page and the command show the same picture of a real capture, whose calibration is off by a shift."""

import contextlib
import json
import time

import cv2
import numpy as np
import pytest
import torch

from viewmend.cli import main, serve
from viewmend.inpainting.protocol import RenderQuality
from viewmend.live.pictures import picture
from viewmend.live.poses import view_camera
from viewmend.live.protocol import Camera
from viewmend.live.renderer import FrameNotReadyError, Renderer, RenderRequest
from viewmend.methods import make_method

SIZE_PX = (480, 360)


def served(capture, model, **options):
    """What `viewmend serve` renders of the first frame, from where its page begins; and the camera."""
    supply = serve.open_supply(serve.Options(source=str(capture), **options))
    supply.start()
    try:
        renderer, end = Renderer(supply, make_method(model)), time.monotonic() + 60
        while renderer.frame is None:
            assert time.monotonic() < end, "no frame came"
            with contextlib.suppress(FrameNotReadyError):
                renderer.prepare(0)
            time.sleep(0.05)
        camera = view_camera(Camera(azimuth=renderer.frame.azimuth + 25), renderer.frame, SIZE_PX)
        result = renderer.render(RenderRequest(0, (camera,), RenderQuality()), None)
        assert renderer.model_error is None
        return picture(result.completed[0], "mended"), camera
    finally:
        supply.stop()


@pytest.mark.parametrize("model", ["small", "telea"])
def test_serve_and_mend_show_the_same_pixels_of_wd2(shared, tmp_path, model):
    capture = shared / "captures/wd2"
    page, camera = served(capture, model)
    pose = torch.linalg.inv(camera.camera_from_world[0])
    path = {"world_from_camera": [pose.tolist()], "K": camera.K[0].tolist(), "width": SIZE_PX[0], "height": SIZE_PX[1]}
    (tmp_path / "path.json").write_text(json.dumps(path))
    arguments = [
        "--path",
        str(tmp_path / "path.json"),
        "--frames",
        "0:1",
        "--model",
        model,
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(["mend", str(capture), *arguments]) == 0
    (written,) = (tmp_path / "out/mended").glob("*.png")
    command = cv2.imread(str(written))[..., ::-1]
    assert command.shape == (360, 480, 3) and command.any(2).mean() > 0.05
    off = np.abs(command.astype(int) - page.astype(int)).max(2)
    assert (off > 1).mean() < 2e-4, "a pose in JSON is rounded, and an edge may fall to the other side of a pixel"
    unaligned, _ = served(capture, model, align=False)
    assert (np.abs(unaligned.astype(int) - page.astype(int)).max(2) > 1).mean() > 0.01, "the alignment shows"
