"""Images of the geometry alone, and stereo videos."""

import io
import json

import numpy as np
import pytest
import torch
from live.live_servers import decode, get, post
from reference.ball import camera_at

from viewmend.geometry.cameras import project
from viewmend.live.client import Client
from viewmend.live.poses import stereo_pair, view_camera
from viewmend.live.protocol import Camera
from viewmend.rendering.proxy_views import CLAY


def frames_of(video: bytes) -> list[np.ndarray]:
    av = pytest.importorskip("av")
    with av.open(io.BytesIO(video)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_the_hull_and_its_points_are_modes(ball):
    with Client(ball.ws) as viewer:
        assert {*viewer.messages["welcome"]["modes"]} >= frozenset({"hull", "points"})
        viewer.send("clock", seek=0, playing=False)
        options = {"width": 64, "height": 64, "modes": ["hull", "points"], "quality": 95}
        look = viewer.look(**options, background="ff0000", depth=True)
        shown = viewer.frame(look, full=True)
        black = viewer.frame(viewer.look(**options), full=True).images[0, "points"].astype(int)
        rendered = viewer.frame(viewer.look(width=64, height=64, modes=["rendered"], quality=95), full=True)
    hull, points = (shown.images[0, mode].astype(int) for mode in ("hull", "points"))
    assert np.abs(hull[32, 32] - 255 * np.array(CLAY)).max() < 20, "lit from the viewer"
    for corner in (hull[2, 2], points[2, 2]):
        assert corner[0] > 230 and corner[1:].max() < 25, "on the background"
    inside = shown.depth[0] > 0
    assert inside.sum() > 100
    body = np.zeros((64, 64), bool)
    body[24:40, 24:40] = True
    own = black[body & (black.sum(-1) > 150)]
    assert 20 < len(own) < 256, "dots of the ball's colours, and gaps"
    assert np.abs(own.mean(0) - rendered.images[0, "rendered"][body].mean(0)).max() < 25
    assert shown.header["stage_ms"]["inpainting"] == 0, "without the model"


def test_colours_of_points_are_computed_once_per_frame(ball, monkeypatch):
    from viewmend.live import renderer

    calls, own = [], renderer.vertex_colours
    monkeypatch.setattr(renderer, "vertex_colours", lambda proxy, views: calls.append(proxy) or own(proxy, views))
    for time, azimuth in ((1, 0), (1, 90), (2, 0)):
        query = f"time={time}&azimuth={azimuth}&mode=points&width=48&height=48"
        assert decode(get(f"{ball.url}/frame.jpg?{query}")[2]).max() > 100
    assert len(calls) == 2


def test_two_eyes_have_no_disparity_at_the_subject_and_some_elsewhere():
    camera = camera_at(40, "t", size=64, distance_m=2.0)
    left, right = stereo_pair(camera, 0.1, torch.zeros(3))
    across = right.centers[0] - left.centers[0]
    assert float(across.norm()) == pytest.approx(0.1, abs=1e-5)
    rightward = camera.world_from_camera[0, :3, 0]
    assert float(across @ rightward) == pytest.approx(0.1, abs=1e-5), "the right eye is on the right"
    ahead = camera.world_from_camera[0, :3, 2]
    points = torch.stack([torch.zeros(3), 0.3 * rightward, -0.5 * ahead, 0.5 * ahead])
    (l_uv, r_uv) = (project(points, eye)[0][0] for eye in (left, right))
    apart = (l_uv - r_uv)[:, 0]
    assert torch.allclose(apart[:2], torch.zeros(2), atol=1e-3) and torch.allclose(l_uv[:, 1], r_uv[:, 1], atol=1e-3)
    assert apart[2] > 0.5 and apart[3] < -0.3, "nearer points have crossed disparity"
    behind = stereo_pair(camera, 0.1, 5 * camera.centers[0])
    assert all(torch.equal(eye.K, camera.K) for eye in behind)


def test_a_stereo_video_has_two_eyes_side_by_side(ball):
    pose = {"azimuth": 20.0}
    size = {"width": 64, "height": 64}
    status, video = post(f"{ball.url}/path.mp4", poses=[pose] * 2, times=[0, 0], stereo_m=0.2, **size)
    assert status == 200, video
    both = frames_of(video)[0].astype(int)
    assert both.shape == (64, 128, 3)
    home = ball.service.renderer.home
    eyes = stereo_pair(view_camera(Camera(**pose), home, (64, 64)), 0.2, home.center)
    for half, eye in zip((both[:, :64], both[:, 64:]), eyes, strict=True):
        asked = {
            "R": eye.camera_from_world[0, :3, :3].flatten().tolist(),
            "T": eye.camera_from_world[0, :3, 3].tolist(),
        }
        lens = {"fx": float(eye.K[0, 0, 0]), "cx": float(eye.K[0, 0, 2]), "cy": float(eye.K[0, 1, 2])}
        alone = frames_of(post(f"{ball.url}/path.mp4", poses=[asked | lens], times=[0], **size)[1])[0]
        assert np.abs(half - alone).mean() < 2
    assert np.abs(both[:, :64] - both[:, 64:]).mean() > 1


@pytest.mark.parametrize(
    ("more", "said"), [({"stereo_m": -1}, "stereo_m"), ({"width": 1600, "height": 1000, "stereo_m": 0.06}, "2100000")]
)
def test_invalid_stereo_videos_are_refused(ball, more, said):
    status, answer = post(f"{ball.url}/path.mp4", **{"poses": [{}], "width": 64, "height": 64} | more)
    assert status == 400 and said in json.loads(answer)["error"]
