"""Views by another model or without some cameras, and their scores, are those of a renderer that has nothing else."""

import json
from dataclasses import replace

import pytest
import torch
from live.live_servers import CAMERAS, PIPELINE, Running, decode, get
from reference.ball import BallCapture, camera_at

from viewmend.live.client import Client
from viewmend.live.frame_source import FrameSource, RigInfo, SourceStatus, Span
from viewmend.live.protocol import unpack
from viewmend.live.renderer import Renderer, RenderRequest
from viewmend.mending import Mender, default_protocol
from viewmend.models.base import RenderQuality
from viewmend.models.checkpoint import load_inpainter
from viewmend.models.smooth_fill import SmoothFill

VIEW = camera_at(75, "view")
LEFT_OUT = CAMERAS.names[2]


class Ball(FrameSource):
    """One frame in memory."""

    def __init__(self, without=()):
        super().__init__(Span(0, 1, 1, 0.0))
        self.status, self.rig = SourceStatus("ready"), RigInfo("ball", None, None)
        self.frame = BallCapture(CAMERAS, 1).read(0).without(without)

    def read(self, index):
        return self.frame


def prepared(inpainter, without=(), error_model=None) -> Renderer:
    renderer = Renderer(Ball(without), inpainter, PIPELINE, error_model=error_model)
    assert renderer.prepare(0)
    return renderer


def rendered(renderer, **asked):
    return renderer.render(RenderRequest(0, (VIEW,), RenderQuality(), **asked), None)


@pytest.fixture(scope="module")
def views():
    return load_inpainter("views")


def test_a_camera_that_is_left_out_neither_colours_nor_carves(views):
    renderer = prepared(views)
    result, whole = rendered(renderer, without=(LEFT_OUT, "unknown")), rendered(renderer)
    (alone,) = rendered(prepared(views, (LEFT_OUT,))).completed
    (completed,) = result.completed
    assert LEFT_OUT in whole.completed[0].view.source_views and LEFT_OUT not in completed.view.candidate_views
    assert completed.view.mask.sum() > whole.completed[0].view.mask.sum(), "the hull is larger"
    assert torch.equal(completed.rgb, alone.rgb)
    assert torch.equal(rendered(renderer).completed[0].rgb, whole.completed[0].rgb)
    with pytest.raises(ValueError, match="two input cameras or more, got 1"):
        rendered(renderer, without=CAMERAS.names[1:])


@pytest.mark.parametrize("without", [(), (LEFT_OUT,)])
def test_another_model_completes_the_same_view(views, without):
    result = rendered(
        prepared(views), model="paper-small", without=without, extra_modes=frozenset({"compared"})
    )
    (alone,) = rendered(prepared(load_inpainter("paper-small"), without, views)).completed
    ((own, extra),) = result.eyes
    assert (extra["compared"][:3] - alone.rgb).abs().max() < 1e-4
    assert (extra["compared"][:3] - own.rgb).abs().max() > 0.02


@pytest.mark.parametrize("model", [None, "paper-small"])
def test_scores_are_those_of_mend(views, model):
    frame = Ball().frame
    inpainter = load_inpainter(model) if model else views
    mender = Mender(inpainter, PIPELINE, error_model=views, protocol=default_protocol(inpainter))
    truth = frame.select([LEFT_OUT])
    step = mender.mend(frame.without([LEFT_OUT]), truth.cameras, truth)
    result = rendered(prepared(views), truth=LEFT_OUT, without=(LEFT_OUT,), model=model)
    assert step.scores is not None and step.scores.ours.psnr_subject is not None
    assert result.psnr_db == pytest.approx(step.scores.ours.psnr_subject, abs=0.01)
    errors = result.extra[0]["error"][0]
    assert errors.shape == truth.rgb.shape[2:] and 0.05 < errors.max() <= 1


def test_a_camera_that_the_first_frame_lacks_can_be_left_out():
    source = Ball((LEFT_OUT,))
    source.rig = replace(source.rig, cameras=CAMERAS)
    renderer = Renderer(source, SmoothFill(), PIPELINE)
    assert renderer.prepare(0) and renderer.rig_json is not None
    assert [camera["name"] for camera in renderer.rig_json["cameras"]] == list(CAMERAS.names)
    assert renderer.left_out((LEFT_OUT,)) == (LEFT_OUT,)


def test_a_name_with_commas_may_come_in_parts():
    renderer = Renderer(Ball(), SmoothFill())
    renderer.rig_json = {"cameras": [{"name": name} for name in ("left,top", "left", "a", "b", "c")]}
    assert (
        renderer.left_out(("left,top",)) == renderer.left_out(("b", "top", "left,top"))[:1] == ("left,top",)
    )
    assert renderer.left_out(["left", "top", "b"]) == ("left,top", "left", "b")
    assert renderer.left_out(("left", "b")) == ("left", "b")


def test_few_variants_are_kept(views):
    renderer = prepared(SmoothFill())
    for name in CAMERAS.names:
        rendered(renderer, without=(name,))
    assert 0 < len(renderer._variants) <= 3


def test_errors_and_score_over_http(ball: Running):
    asked = f"{ball.url}/frame.jpg?time=0&mode=error&camera={LEFT_OUT}&without={LEFT_OUT}"
    status, headers, content = get(asked)
    assert status == 200 and 5 < float(headers["X-Viewmend-PSNR"]) < 60
    assert decode(content).shape[:2] == tuple(CAMERAS.size_px[2].tolist()[::-1])
    assert get(f"{ball.url}/frame.jpg?time=0&mode=completed")[1]["X-Viewmend-PSNR"] is None
    for wrong in (
        "mode=error",
        "mode=compared",
        "model=../views",
        "camera=none",
        "without=" + ",".join(CAMERAS.names),
    ):
        status, _, content = get(f"{ball.url}/frame.jpg?time=0&{wrong}")
        assert status == 400 and "expected" in json.loads(content)["error"], wrong


def test_assets_without_a_camera(ball: Running):
    shapes = {}
    for without in ("", LEFT_OUT):
        status, headers, content = get(f"{ball.url}/assets/0?without={without}")
        assert status == 200
        shapes[without] = [camera["name"] for camera in unpack(content)[0]["cameras"]], headers["ETag"]
    assert shapes[""][0] == list(CAMERAS.names) and shapes[LEFT_OUT][0] == [
        n for n in CAMERAS.names if n != LEFT_OUT
    ]
    assert shapes[""][1] != shapes[LEFT_OUT][1]
    status, _, content = get(f"{ball.url}/assets/0?without={','.join(CAMERAS.names[1:])}")
    assert status == 404 and "two input cameras" in json.loads(content)["error"]


def test_a_viewer_leaves_a_camera_out_and_compares(ball: Running):
    with Client(ball.ws) as viewer:
        assert "paper-small" in viewer.messages["welcome"]["models"]
        look = {"width": 48, "height": 48, "modes": ["completed", "compared"], "model": "paper-small"}
        shown = viewer.frame(viewer.look(**look, without=[LEFT_OUT], camera={"azimuth": 75}))
        assert LEFT_OUT not in shown.header["source_views"] and len(shown.header["depth_m"]) == 2
        mended, compared = (image.astype(int) for image in shown.images.values())
        assert abs(mended - compared).max() > 10
