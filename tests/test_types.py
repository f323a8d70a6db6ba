"""Frames and views: selections copy nothing until a stack is read, and wrong tensors are refused."""

import math
import pickle
from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, photograph, ring
from reference.forged import forged
from torch.nn import functional as F

from viewmend.models.classical import Telea
from viewmend.stream import Stream
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import IncompleteView, Silhouettes


@pytest.fixture(scope="module")
def frame():
    """A frame of four cameras of two sizes."""
    frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
    sizes = frame.cameras.size_px.clone()
    sizes[[0, 2]] = torch.tensor([60, 50])
    return replace(frame, cameras=replace(frame.cameras, size_px=sizes))


def test_a_selection_refers_to_the_images_and_is_stacked_once(frame):
    names = tuple(frame.cameras.names[n] for n in (2, 0))
    chosen = frame.select(names)
    assert chosen.cameras.names == names and chosen.time == frame.time
    assert torch.equal(chosen.depth, frame.depth[[2, 0], :50, :60])
    for field in ("rgb", "mask"):
        images = getattr(frame, field)
        assert [part.data_ptr() for part in chosen.per_camera(field)] == [
            images[n].data_ptr() for n in (2, 0)
        ]
        stack = getattr(chosen, field)
        assert torch.equal(stack, images[[2, 0], ..., :50, :60]) and getattr(chosen, field) is stack
    assert replace(chosen, time=7).rgb is chosen.rgb
    assert torch.equal(pickle.loads(pickle.dumps(frame.select(names))).rgb, chosen.rgb)
    with pytest.raises(ValueError, match="expected cameras among"):
        frame.select(("unknown",))
    with pytest.raises(AttributeError, match="has no attribute size"):
        _ = chosen.size


def test_a_selection_without_masks_has_none(frame):
    bare = replace(frame, mask=None)
    chosen = bare.select(bare.cameras.names[1:3])
    assert chosen.mask is None and not chosen.per_camera("mask") and len(chosen.per_camera("rgb")) == 2
    assert torch.equal(chosen.select(bare.cameras.names[2:3]).rgb, bare.rgb[2:3, :, :50, :60])


def test_all_cameras_of_a_frame_are_the_frame_itself():
    frame = photograph(ring(3, 16))
    assert frame.select(frame.cameras.names) is frame and frame.without([]) is frame
    turned = frame.select(frame.cameras.names[::-1])
    assert turned.cameras.names == ("c2", "c1", "c0") and torch.equal(turned.rgb[0], frame.rgb[2])
    assert len(frame.select([]).cameras) == 0 == len(frame.select([]).rgb)


def test_names_are_a_list_and_no_string():
    cameras = ring(3, 16)
    frame = photograph(replace(cameras, names=("1", "2", "12")))
    for choose in (frame.select, frame.without):
        with pytest.raises(ValueError, match=r"as a list of names, got the string '12'; write \['12'\]"):
            choose("12")
    assert frame.without(["12"]).cameras.names == ("1", "2")


# What a frame's check refuses.

RIG = photograph(ring(3, 16))
CAMERAS = RIG.cameras
TALL = torch.tensor([[16, 20]]).expand(3, 2)


def of_cameras(**fields):
    return forged(RIG, cameras=forged(CAMERAS, **fields))


@pytest.mark.parametrize(
    "frame, message",
    [
        (
            forged(RIG, rgb=RIG.rgb / 255),
            r"expected rgb as torch.uint8, got torch.float32; scale it to 0 to 255",
        ),
        (
            forged(RIG, rgb=RIG.rgb.movedim(1, -1)),
            r"rgb of shape \(3, 3, 16, 16\).*got \(3, 16, 16, 3\).*channels first",
        ),
        (
            forged(RIG, rgb=RIG.rgb[:2]),
            r"expected rgb of shape \(3, 3, 16, 16\).*got \(2, 3, 16, 16\); give one image",
        ),
        (
            forged(RIG, rgb=RIG.rgb[..., :9]),
            r"rgb of shape \(3, 3, 16, 16\).*got \(3, 3, 16, 9\); .* size_px",
        ),
        (
            forged(RIG, rgb=RIG.rgb.numpy()),
            "expected rgb as a tensor, got ndarray; convert it with torch.as_tensor",
        ),
        (
            forged(RIG, mask=RIG.mask > 0),
            "expected mask as torch.uint8, got torch.bool; scale it to 0 to 255",
        ),
        (
            forged(RIG, mask=RIG.mask / 255),
            "expected mask as torch.uint8, got torch.float32; scale it to 0 to 255",
        ),
        (forged(RIG, mask=RIG.mask // 255), "expected masks of 0 to 255, got masks of 0 and 1; multiply"),
        (
            forged(RIG, mask=RIG.mask[:, :9]),
            r"mask of shape \(3, 16, 16\).*got \(3, 9, 16\); give one mask per camera",
        ),
        (
            of_cameras(names=("a", "b", "a")),
            r"expected a different name for each camera, got .*\['a'\]; rename",
        ),
        (of_cameras(names=("a", "b")), r"expected K of shape \(2, 3, 3\), got \(3, 3, 3\); give one"),
        (of_cameras(K=CAMERAS.K.double()), r"expected K as torch.float32, got torch.float64; .*\.float\(\)"),
        (
            of_cameras(camera_from_world=CAMERAS.camera_from_world[:, :3]),
            r"\(3, 4, 4\), got \(3, 3, 4\); .* 0 0 0 1",
        ),
        (
            of_cameras(size_px=CAMERAS.size_px.float()),
            r"expected size_px as torch.int64 .*got torch.float32; .*\.long\(\)",
        ),
        (
            of_cameras(K=CAMERAS.K.mT),
            r"camera 'c0': expected K as \[\[fx, skew, cx\].*; convert it to OpenCV's convention",
        ),
        (of_cameras(K=CAMERAS.K * math.nan), "camera 'c0': expected K as .*, got .*nan"),
        *(
            (
                of_cameras(camera_from_world=pose),
                "camera 'c1': expected camera_from_world as a rotation and a translation.*; divide the rotation",
            )
            for pose in (
                CAMERAS.camera_from_world * torch.tensor([1.0, 2.0, 1.0])[:, None, None],
                CAMERAS.camera_from_world
                * torch.tensor([[1.0] * 4, [1.0, 1.0, -1.0, 1.0], [1.0] * 4])[..., None],
                CAMERAS.camera_from_world / torch.tensor([1.0, 0.0, 1.0])[:, None, None],
                CAMERAS.camera_from_world
                * torch.tensor([[1.0] * 4, [1.0, 1.0, 1.0, 0.0], [1.0] * 4])[..., None],
            )
        ),
        (
            forged(RIG, cameras=CAMERAS.resized(8, 8)),
            "zeros beyond .* at most 8 x 8, got images of 16 x 16 .*; give the K and size_px",
        ),
        (
            forged(RIG, cameras=CAMERAS.resized(8, 16), mask=None),
            "zeros beyond .* at most 8 x 16, got images of 16 x 16 .*; give the K and size_px",
        ),
        (of_cameras(size_px=TALL), r"rgb of shape \(3, 3, 20, 16\).*got \(3, 3, 16, 16\)"),
        (RIG.select([]), "expected at least one camera, got none"),
        (forged(RIG, time=0.033), "expected time as a whole number, the frame's index, got 0.033; count"),
        (forged(RIG, time=torch.tensor(3)), "expected time as a whole number, .*, got tensor"),
    ],
)
def test_frames_of_wrong_types_or_sizes_are_refused(frame, message):
    with pytest.raises(ValueError, match=message):
        frame.check()
    with pytest.raises(ValueError, match=message):
        Stream(Telea()).add_frame(frame)
    if frame.mask is not None and frame.mask is not RIG.mask and len(frame.cameras):
        with pytest.raises(ValueError, match=message):
            forged(Silhouettes(RIG.mask, CAMERAS), mask=frame.mask).check()


def test_right_frames_pass(frame):
    padded = replace(frame, rgb=F.pad(frame.rgb, (0, 3)), mask=F.pad(frame.mask, (0, 3)), depth=None)
    some = frame.without(frame.cameras.names[1:2])
    noise = torch.zeros_like(frame.mask)
    noise[0, 0, :2] = 1
    for right in (
        frame,
        padded,
        some,
        *(replace(frame, mask=mask) for mask in (None, 0 * frame.mask, noise)),
    ):
        right.check()
    Silhouettes(padded.mask, frame.cameras).check()


# What a view's check refuses.

TARGET = camera_at(100, "t", 16)
CLOSE = ("c1", "c0")
SEEN = photograph(TARGET)
ALPHA = SEEN.mask[0] / 255
VIEW = IncompleteView(
    TARGET, SEEN.rgb[0] / 255, ALPHA, 0 * ALPHA, SEEN.depth[0], CLOSE, ALPHA.expand(2, 16, 16) / 2, 0
)
FLOAT = r"convert it with \.float\(\), and divide 8-bit images by 255"


@pytest.mark.parametrize(
    "view, message",
    [
        (
            forged(VIEW, rgb=VIEW.rgb * 255),
            "expected rgb in \\[0, 1\\], got values from 0 to .*; divide 8-bit images by 255",
        ),
        (forged(VIEW, rgb=VIEW.rgb - 1), "expected rgb in \\[0, 1\\], got values from -1 to .*clamp"),
        (
            forged(VIEW, rgb=(VIEW.rgb * 255).byte()),
            f"expected rgb as torch.float32, got torch.uint8; {FLOAT}",
        ),
        (forged(VIEW, rgb=VIEW.rgb.double()), f"expected rgb as torch.float32, got torch.float64; {FLOAT}"),
        (
            forged(VIEW, mask=VIEW.mask.bfloat16()),
            f"expected mask as torch.float32, got torch.bfloat16; {FLOAT}",
        ),
        (forged(VIEW, error=VIEW.error > 0), f"expected error as torch.float32, got torch.bool; {FLOAT}"),
        (forged(VIEW, error=VIEW.error + 255), "expected error in .*, got values from 255 to 255; divide"),
        (
            forged(VIEW, rgb=VIEW.rgb.numpy()),
            "expected rgb as a tensor, got ndarray; convert it with torch.as_tensor",
        ),
        (forged(VIEW, depth=None), "expected depth as a tensor, got NoneType"),
        (
            forged(VIEW, rgb=VIEW.rgb.movedim(0, -1)),
            r"rgb of shape \(3, 16, 16\), got \(16, 16, 3\); .* channels first",
        ),
        (
            forged(VIEW, depth=VIEW.depth[:9]),
            r"depth of shape \(16, 16\), got \(9, 16\); .* the view's camera",
        ),
        (
            forged(VIEW, camera=TARGET.resized(20, 20)),
            r"rgb of shape \(3, 20, 20\), got \(3, 16, 16\); .* the view's camera",
        ),
        (forged(VIEW, camera=CAMERAS), "expected the camera of one view, got 3; choose one"),
        (
            forged(VIEW, source_views=("c1",)),
            r"weights of shape \(1, 16, 16\), got \(2, 16, 16\); .* each of source_views",
        ),
        (
            forged(VIEW, source_views=(), weights=VIEW.weights[:0]),
            "expected source_views with a camera, got none",
        ),
        (
            forged(VIEW, weights=VIEW.weights / 2),
            "expected weights that sum to 1 or 0 .*; divide them by their sum",
        ),
        (
            forged(VIEW, weights=VIEW.weights * 2),
            "expected weights that sum to 1 or 0 .*; divide them by their sum",
        ),
        (
            forged(VIEW, depth=1 / VIEW.mask),
            "expected finite numbers in depth, got NaN or infinity; use 0 where there is no",
        ),
        (
            forged(VIEW, depth=VIEW.depth * math.nan),
            "expected finite numbers in depth, got NaN or infinity; use 0 where",
        ),
        (
            forged(VIEW, depth=VIEW.depth - 1),
            r"expected depth in \[0, inf\], got values from -1 to .*; use 0 where",
        ),
        (forged(VIEW, fade=VIEW.mask * 2), "expected fade in .*, got values from 0 to 2"),
        (
            forged(VIEW, target_mask=VIEW.mask.double()),
            f"expected target_mask as torch.float32, got torch.float64; {FLOAT}",
        ),
        (forged(VIEW, rgb=VIEW.rgb * math.nan), "expected finite numbers in rgb, got NaN or infinity; use 0"),
        (forged(VIEW, mask=VIEW.mask / 0), "expected finite numbers in mask, got NaN or infinity; use 0"),
        (
            forged(VIEW, silhouettes=Silhouettes(RIG.mask // 255, CAMERAS)),
            "expected masks of 0 to 255, got masks of 0 and 1",
        ),
    ],
)
def test_views_of_wrong_types_sizes_or_ranges_are_refused(view, message):
    VIEW.check(CAMERAS.names)
    with pytest.raises(ValueError, match=message):
        view.check(CAMERAS.names)


def test_a_view_may_leave_its_range_by_rounding():
    view = replace(
        VIEW, rgb=VIEW.rgb * 1.001 - 0.001, weights=VIEW.weights.half().float() * 1.001, fade=VIEW.error
    )
    replace(view, target_mask=VIEW.mask, silhouettes=Silhouettes(RIG.mask, CAMERAS)).check(CAMERAS.names)
