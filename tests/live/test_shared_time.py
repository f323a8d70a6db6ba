"""A time that processes share: the same values, read where they lie."""

import pickle

import numpy as np
import torch
from live_servers import CAMERAS, PIPELINE
from reference.ball import camera_at, photograph

from viewmend.geometry.proxy import GeometryProxy
from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.inpainting.protocol import ContextProvider, RenderQuality
from viewmend.live.clock import Span
from viewmend.live.frames import FrameSupply, Rig
from viewmend.live.renderer import Renderer, RenderRequest
from viewmend.live.shared_time import SharedTime
from viewmend.methods import make_method
from viewmend.observation import observe

ENOUGH = 20_000
"""Bytes for names, shapes and the like; the arrays here are some hundred thousand."""


def passed_on(shared):
    """What another process gets, and the buffers that its arrays lie in: read only, as in an object store."""
    lent = []
    content = pickle.dumps(shared, protocol=5, buffer_callback=lent.append)
    buffers = [memoryview(bytes(buffer.raw())) for buffer in lent]
    return pickle.loads(content, buffers=buffers), buffers, content


def ball_time(inpainter=None):
    return SharedTime.of(photograph(CAMERAS, 3), None, PIPELINE.hull, inpainter or SmoothFill())


def tensors_of(shared):
    pyramids = [level for made in shared.encoded.values() for level in made.levels]
    return [shared.frame.rgb, shared.frame.mask, shared.proxy.mesh.vertices, *shared.depths.values(), *pyramids]


def test_nothing_is_copied_and_all_is_the_same():
    shared = ball_time(make_method("views"))
    got, buffers, content = passed_on(shared)
    assert len(content) < ENOUGH < shared.bytes
    places = {np.frombuffer(buffer, np.uint8).ctypes.data for buffer in buffers}
    for before, after in zip(tensors_of(shared), tensors_of(got), strict=True):
        assert torch.equal(before, after) and after.data_ptr() in places
    assert got.frame.time == 3 and got.frame.cameras.names == CAMERAS.names and got.bytes == shared.bytes


def test_a_tensor_that_is_met_twice_is_passed_once():
    shared = ball_time()
    mask = shared.frame.mask
    twice = SharedTime(shared.frame, shared.proxy, shared.depths, {"one": (mask,), "two": (mask,)})
    got, buffers, _ = passed_on(twice)
    assert got.encoded["one"][0] is got.encoded["two"][0] is got.frame.mask
    assert sum(len(buffer) == mask.numel() for buffer in buffers) == 1


def test_a_stream_finds_all_made_that_it_would_make():
    model = make_method("views")
    own = observe(photograph(CAMERAS, 3), None, PIPELINE.hull)
    got = passed_on(ball_time(model))[0].observation()
    assert torch.equal(own.proxy.mesh.vertices, got.proxy.mesh.vertices)
    assert torch.equal(own.depth(CAMERAS.names), torch.stack([got.depths[name] for name in CAMERAS.names]))
    model.encode_cameras(own.context(CAMERAS.names), ContextProvider(lambda *_: None, memory=lambda _: own.encoded))
    assert own.encoded.keys() == got.encoded.keys() and len(got.encoded) == 2 * len(CAMERAS)


def test_a_renderer_renders_no_depth_that_another_process_did(monkeypatch):
    made = {3: ball_time().observation()}

    class Supply(FrameSupply):
        def read(self, time):
            return photograph(CAMERAS, time)

        def made(self, time):
            return made.get(time)

    supply = Supply(Span(0, 4, 4, 15.0))
    supply.rig = Rig("ball", None, None)
    asked = []
    depth = GeometryProxy.depth
    monkeypatch.setattr(GeometryProxy, "depth", lambda own, cameras: asked.extend(cameras.names) or depth(own, cameras))
    renderer = Renderer(supply, SmoothFill(), PIPELINE)
    assert renderer.prepare(3)
    renderer.render(RenderRequest(3, (camera_at(20, "view"),), RenderQuality()), None)
    assert set(asked) <= {"view"}
    del made[3]
    assert Renderer(supply, SmoothFill(), PIPELINE).prepare(3)
    assert set(asked) & set(CAMERAS.names)


def test_tokens_of_the_transformer_are_shared_too():
    model = make_method("small")
    got, *_ = passed_on(ball_time(model))
    assert set(got.encoded) == set(CAMERAS.names)
    frame = got.encoded["c1"]
    assert frame.name == "c1" and frame.keys_values.isfinite().all() and len(frame.tokens) == len(frame.places)


def test_without_a_hull_there_is_the_frame():
    frame = photograph(CAMERAS, 0)
    shared = SharedTime.of(type(frame)(frame.cameras, frame.rgb, 0 * frame.mask, 0), None, PIPELINE.hull, SmoothFill())
    got, *_ = passed_on(shared)
    assert got.observation() is None and torch.equal(got.frame.rgb, frame.rgb)
