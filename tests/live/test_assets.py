"""The assets of a frame over HTTP: what they contain, how they are cached, and their limits."""

import asyncio
import json
import threading
import zlib

import cv2
import numpy as np
import pytest
import torch
from live.live_servers import CAMERAS, WAIT_S, get, in_own_loop, running
from reference.ball import BallCapture

from viewmend.geometry.cameras import project
from viewmend.geometry.sampling import in_view
from viewmend.live import assets as live_assets
from viewmend.live.assets import Asset, AssetStore, BusyError, FrameAssets, pack_differences
from viewmend.live.protocol import unpack
from viewmend.rendering.blending import BlendConfig

TOKEN = "0123456789abcdef"


def unpack_differences(data, rows, columns):
    """The inverse of `pack_differences`, value by value."""
    planes = np.frombuffer(zlib.decompress(data), np.uint8).reshape(4, columns, rows).astype(np.int64)
    values = np.zeros((rows, columns), np.int64)
    for column in range(columns):
        last = 0
        for row in range(rows):
            folded = sum(int(planes[byte, column, row]) << (8 * byte) for byte in range(4))
            last += (folded >> 1) ^ -(folded & 1)
            values[row, column] = last
    return values


def read_shape(content):
    header, parts = unpack(content)
    about = {part["kind"]: part for part in header["parts"]}
    arrays = {
        part["kind"]: unpack_differences(data, part["rows"], part["columns"])
        for part, data in zip(header["parts"], parts, strict=True)
    }
    return header, about, arrays


def read_image(content, camera):
    """RGB and mask of an image."""
    rgb = cv2.imdecode(np.frombuffer(content[: camera["jpeg_bytes"]], np.uint8), cv2.IMREAD_COLOR_RGB)
    mask = np.frombuffer(zlib.decompress(content[camera["jpeg_bytes"] :]), np.uint8)
    return rgb, mask.reshape(camera["height"], camera["width"])


@pytest.mark.parametrize("values", [[[0], [0]], [[70_000, 1], [3, 65_535], [0, 0]], np.zeros((0, 3))])
def test_differences_are_exact(values):
    values = np.array(values, np.int64)
    assert np.array_equal(unpack_differences(pack_differences(values), *values.shape), values)


def test_a_shape_is_the_proxy_with_the_blending_rule(ball):
    status, headers, content = get(f"{ball.url}/assets/1")
    assert status == 200 and headers["content-type"] == "application/octet-stream"
    header, about, arrays = read_shape(content)
    renderer = ball.service.renderer
    frame = ball.service.source.read(1)
    proxy = renderer.geometry(frame)
    step = np.array(about["positions"]["step"])
    positions = np.array(about["positions"]["low"]) + step * arrays["positions"]
    assert np.abs(positions - proxy.mesh.vertices.numpy()).max() <= 0.51 * step.max() < 1e-4
    assert np.array_equal(arrays["faces"].reshape(-1, 3), proxy.mesh.faces.numpy())
    blend = BlendConfig()
    assert header["time"] == 1 and header["blend"]["view_power"] == blend.view_power
    assert header["blend"]["bias_m"] == pytest.approx(blend.depth_bias * float(proxy.bounds.size_m.norm()))
    assert header["center"] == pytest.approx(proxy.mesh.vertices.mean(0).tolist(), abs=1e-5)


def test_images_show_the_subject_as_their_cameras_see_it(ball):
    header, *_ = read_shape(get(f"{ball.url}/assets/1")[2])
    frame = ball.service.source.read(1)
    assert [camera["name"] for camera in header["cameras"]] == list(frame.cameras.names)
    for number, camera in enumerate(header["cameras"]):
        status, headers, content = get(f"{ball.url}/assets/1/{number}")
        assert status == 200 and headers["content-type"] == "image/jpeg"
        rgb, mask = read_image(content, camera)
        whole_K = frame.cameras.K[number]
        left, top = (round(float(whole_K[axis, 2]) - camera["K"][3 * axis + 2]) for axis in (0, 1))
        height, width = mask.shape
        part = (
            frame.rgb[number, :, top : top + height, left : left + width].movedim(0, -1).numpy().astype(int)
        )
        assert (
            np.abs(
                mask.astype(int) - frame.mask[number, top : top + height, left : left + width].numpy()
            ).max()
            <= 8
        )
        assert int((frame.mask[number] > 8).sum()) == int((mask > 0).sum()), "the foreground is complete"
        assert np.abs(rgb - part)[mask > 200].mean() < 5


def test_vertices_have_the_colours_of_the_surface(ball):
    _, _, arrays = read_shape(get(f"{ball.url}/assets/0")[2])
    frame = ball.service.source.read(0)
    proxy, camera = ball.service.renderer.geometry(frame), frame.cameras[0]
    colours = arrays["colours"]
    assert colours.min() >= 0 and colours.max() <= 255
    to_camera = torch.nn.functional.normalize(camera.centers - proxy.mesh.vertices, dim=-1)
    uv, z = project(proxy.mesh.vertices, camera)
    frontal = ((proxy.normals * to_camera).sum(-1) > 0.9) & in_view(uv, z, camera)[0]
    column, row = uv[0, frontal].long().unbind(-1)
    seen = frame.rgb[0, :, row, column].T.numpy().astype(int)
    assert len(seen) > 10 and np.abs(colours[frontal.numpy()] - seen).mean() < 25


def test_versioned_assets_are_cached_for_good_and_others_revalidated(ball):
    version = ball.service.renderer.rig_json["assets"]
    for path in ("/assets/0", "/assets/0/2"):
        _, headers, content = get(f"{ball.url}{path}?v={version}")
        assert "immutable" in headers["cache-control"] and headers["cache-control"].startswith("public")
        tag = headers["etag"]
        for query in ("", "?v=other"):
            _, headers, again = get(f"{ball.url}{path}{query}")
            assert (
                headers["cache-control"] == "public, no-cache" and headers["etag"] == tag and again == content
            )
        for known in (tag, f'"other", W/{tag}', "*"):
            status, headers, body = get(f"{ball.url}{path}", {"If-None-Match": known})
            assert status == 304 and not body and headers["etag"] == tag
        assert get(f"{ball.url}{path}", {"If-None-Match": '"other"'})[0] == 200
    assert get(f"{ball.url}/assets/0")[1]["etag"] != get(f"{ball.url}/assets/1")[1]["etag"]


def test_malformed_requests_are_refused(ball):
    for path, status in {
        "9": 404,
        "0/6": 404,
        "-1": 400,
        "x": 400,
        "0/x": 400,
        "0?w=1": 400,
        "9" * 5000: 400,
    }.items():
        answered, _, body = get(f"{ball.url}/assets/{path}")
        assert answered == status and json.loads(body)["error"], path


def test_assets_need_the_token():
    with running(token=TOKEN) as server:
        for path in ("/assets/0", "/assets/0/1"):
            assert get(server.url + path)[0] == 401
            assert get(f"{server.url}{path}?token={TOKEN}")[0] == 200
            version = server.service.renderer.assets_version
            status, headers, _ = get(f"{server.url}{path}?v={version}", {"Authorization": f"Bearer {TOKEN}"})
            assert status == 200 and headers["cache-control"].startswith("private"), "no proxy may share it"


FRAME = BallCapture(CAMERAS, 1).read(0)


def made_of(size=400_000):
    return FrameAssets(Asset(bytes(size), "text/plain"), ())


def store_of(make=lambda frame, without: made_of()):
    """A store of one megabyte whose frames are all in memory, except for one."""
    return AssetStore(lambda index: None if index == 99 else FRAME, make, 1.0)


@in_own_loop
async def test_memory_is_bounded_and_the_last_used_is_kept():
    store = store_of()
    first = await store.get(0, "a")
    for index in range(1, 30):
        await store.get(index, "a")
        assert await store.get(0, "a") is first
        assert await store.get(0, "a", (f"cam{index}",)) is not first, "without a camera"
        assert await store.get(0, "a") is first
        assert store.size_bytes == sum(made.size_bytes for made in store._kept.values()) <= 1_000_000
    assert await store.get(0, "b") is not first, "another rig has other frames"
    assert store.size_bytes == 400_000 and not store._making


@in_own_loop
async def test_a_frame_is_made_once_for_all_who_wait():
    made = []

    def make(frame, without):
        made.append(made_of())
        return made[-1]

    store = store_of(make)
    results = await asyncio.gather(*(store.get(3, "a") for _ in range(20)))
    assert len({id(result) for result in results}) == len(made) == 1


@in_own_loop
async def test_frames_in_the_making_are_limited_and_a_late_one_ends(monkeypatch):
    go = threading.Event()

    def make(frame, without):
        assert go.wait(WAIT_S)
        return made_of(1000)

    store = store_of(make)
    waiting = [asyncio.create_task(store.get(index, "a")) for index in range(live_assets.MAX_MAKING)]
    await asyncio.sleep(0)
    with pytest.raises(BusyError):
        await store.get(50, "a")
    go.set()
    await asyncio.gather(*waiting)
    monkeypatch.setattr(live_assets, "READ_S", 0.0)
    with pytest.raises(TimeoutError):
        await store.get(99, "a")
    assert not store._making


@in_own_loop
async def test_a_frame_without_a_subject_has_no_assets():
    def make(frame, without):
        raise ValueError("no foreground")

    store = store_of(make)
    for _ in range(2):
        with pytest.raises(ValueError, match="no foreground"):
            await store.get(1, "a")
    assert not store._making and not store._kept
