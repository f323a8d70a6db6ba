from dataclasses import replace

import numpy as np
import pytest
import torch
from live.live_servers import decode, get, running

from viewmend.live.client import Client
from viewmend.live.encoding import (
    COLOURS,
    draw_mode,
    mean_confidence,
    pack_depth,
    surface_depth,
    unpack_depth,
)
from viewmend.models.smooth_fill import SmoothFill


def test_every_mode(ball_view):
    rgb = (ball_view.rgb.movedim(0, -1) * 255).numpy()
    images = {
        mode: draw_mode(ball_view, mode) for mode in ("rendered", "holes", "completed", "depth", "coverage")
    }
    assert all(image.shape == (48, 48, 3) and image.dtype == np.uint8 for image in images.values())
    assert np.abs(images["completed"] - rgb).max() <= 1
    assert images["rendered"][22, 22].tolist() == [0, 0, 0]
    assert images["holes"][22, 22].tolist() == [255, 38, 140] == images["coverage"][22, 22].tolist()
    assert (images["holes"][12] == images["rendered"][12]).all()
    near, far = images["depth"][24, 24].tolist(), images["depth"][24, 10].tolist()
    assert not images["depth"][0, 0].any() and near[0] > near[2] and far[2] > near[2], "red is near"
    left, right = images["coverage"][24, 18].astype(float), images["coverage"][24, 30].astype(float)
    assert np.allclose(left / left.max(), np.array(COLOURS[0]) / max(COLOURS[0]), atol=0.02)
    assert np.allclose(right / right.max(), np.array(COLOURS[1]) / max(COLOURS[1]), atol=0.02)


def test_holes_do_not_depend_on_the_error_rule(ball_view):
    whole = replace(ball_view, view=replace(ball_view.view, error=ball_view.view.mask))
    for mode in ("holes", "coverage"):
        assert (draw_mode(whole, mode) == draw_mode(ball_view, mode)).all()


def test_confidence_is_a_heat_map(ball_view):
    view, alpha = ball_view.view, 0.5 * ball_view.view.mask
    sure, unsure = (replace(ball_view, alpha=alpha, confidence=value * view.mask) for value in (1.0, 0.25))
    assert mean_confidence(ball_view) is None
    assert mean_confidence(sure) == pytest.approx(1, abs=1e-3) and mean_confidence(unsure) == pytest.approx(
        0.25
    )
    yellow, violet = (draw_mode(one, "confidence") for one in (sure, unsure))
    assert (
        np.abs(yellow[24, 24] - np.array([253, 231, 36]) / 2).max() <= 1
        and violet[24, 24, 2] > violet[24, 24, 0]
    )
    assert yellow[0, 0].tolist() == [0, 0, 0], "no subject, no colour"
    grey = draw_mode(ball_view, "confidence")
    assert grey.max() > 40 and (grey == grey[..., :1]).all(), "without confidence, without colour"


def test_a_soft_outline_has_the_depth_of_the_neighbouring_surface(ball_view):
    assert torch.equal(surface_depth(ball_view), ball_view.view.depth)
    depth, alpha = torch.zeros(48, 48), torch.zeros(48, 48)
    depth[10:20, 10:20], alpha[10:20, 10:20], alpha[20, 10:20], alpha[25, 25] = 2.0, 1.0, 0.3, 0.3
    shown = surface_depth(replace(ball_view, alpha=alpha, depth=depth))
    assert (shown[20, 10:20] == 2).all() and shown[21].max() == 0 == shown[25, 25]


def test_depth_is_drawn_and_sent_within_the_target_mask(ball_view):
    inside = (torch.arange(48) < 24).float().expand(48, 48)
    cut = replace(ball_view, view=replace(ball_view.view, target_mask=inside))
    whole, image = draw_mode(ball_view, "depth"), draw_mode(cut, "depth")
    assert whole[:, 24:].any() and not image[:, 24:].any() and image[:, :24].any()
    assert (draw_mode(cut, "depth", "0040ff")[:, 24:] == (0, 0x40, 0xFF)).all()
    assert torch.equal(surface_depth(cut), ball_view.view.depth * inside)


@pytest.mark.parametrize("stride", [1, 2, 4])
@pytest.mark.parametrize("size", [(48, 48), (47, 50), (3, 2)])
def test_depth_comes_back_where_it_was_taken(size, stride):
    rows, columns = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    depth = 1.5 + rows / 100 + columns / 37
    depth[rows < columns / 2] = 0
    packed = pack_depth(depth, stride)
    back = unpack_depth(packed)
    taken = ([min(stride * n + stride // 2, side - 1) for n in range(-(-side // stride))] for side in size)
    expected = depth.numpy()[np.ix_(*taken)]
    assert back.shape == expected.shape and np.abs(back - expected).max() < 1e-4


def test_depth_without_a_surface():
    assert (unpack_depth(pack_depth(torch.zeros(20, 20), 4)) == 0).all()
    assert np.allclose(unpack_depth(pack_depth(torch.full((20, 20), 2.0), 4)), 2.0, atol=1e-4)


@pytest.mark.parametrize("mode", ["completed", "rendered", "holes", "depth", "coverage", "confidence"])
def test_every_mode_is_drawn_on_the_background(ball_view, mode):
    black, blue = draw_mode(ball_view, mode), draw_mode(ball_view, mode, "0040ff")
    empty, solid = ball_view.view.mask == 0, ball_view.opacity == 1
    assert bool(empty.any()) and (blue[empty.numpy()] == (0, 0x40, 0xFF)).all()
    assert (blue[solid.numpy()] == black[solid.numpy()]).all() and bool(solid.any())


def test_hull_modes_need_an_image_of_the_hull(ball_view):
    with pytest.raises(KeyError):
        draw_mode(ball_view, "hull")
    hull = torch.zeros(4, 48, 48)
    hull[:, 10:20, 10:20] = 1
    image = draw_mode(ball_view, "hull", "0000ff", {"hull": hull})
    assert image[15, 15].tolist() == [255, 255, 255] and image[24, 24].tolist() == [0, 0, 255]


def test_the_default_background_is_the_models():
    class OnWhite(SmoothFill):
        background = "white"

    with running(inpainter=OnWhite()) as server, Client(server.ws) as viewer:
        assert viewer.messages["welcome"]["background"] == "ffffff"
        images = [viewer.frame(viewer.look(width=64, height=48)).images[0, "completed"]]
        url = f"{server.url}/frame.jpg?time=0&width=64&height=48"
        images += [decode(get(url + query)[2]) for query in ("", "&background=000000")]
        assert [round(float(image[:4, :4].mean())) for image in images] == [255, 255, 0]
