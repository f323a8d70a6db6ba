"""RenderResult views of an analytic ball."""

from dataclasses import replace

import pytest
import torch
from reference.ball import camera_at, photograph, proxy, ring

from viewmend.geometry.mesh import Mesh
from viewmend.rendering.blending import Blend
from viewmend.rendering.error_rules import Evidence, error_rule
from viewmend.rendering.view import RenderConfig, render_view

BALL = proxy()


def test_the_ball_is_rendered_as_it_is():
    target = camera_at(40, "t", 64, 0.4)
    truth = photograph(target)
    view = render_view(photograph(ring(12, 96)), BALL, target, RenderConfig())
    right = (view.mask > 0) & (view.error == 0) & (truth.mask[0] > 0)
    assert right.sum() > 0.97 * (truth.mask > 0).sum()
    # The exact colour is a function of position; one source pixel is 1.5 cm, 3 % of the range, at the rim more.
    assert (view.rgb - truth.rgb[0] / 255)[:, right].abs().mean() < 0.004
    assert (view.mask - (truth.mask[0] > 0).float()).abs().mean() < 0.01


def test_what_travels_is_consistent():
    cameras = ring(12)[[0, 2, 3]]  # nothing sees the back
    view = render_view(photograph(cameras, 7), BALL, camera_at(135, "t"), RenderConfig())
    missing, coloured = view.error == 1, (view.error == 0) & (view.mask == 1)
    assert missing.sum() > 50 and coloured.sum() > 50
    assert bool((view.mask[missing] == 1).all())
    assert view.rgb[:, missing].abs().max() == 0
    assert view.rgb[:, view.mask == 0].abs().max() == 0
    assert view.rgb[:, coloured].min() > 0.02
    torch.testing.assert_close(view.weights.sum(0), coloured.float())
    assert torch.equal(view.mask > 0, view.depth > 0)
    assert view.time == 7 and set(view.source_views) == set(cameras.names)


def test_holes_are_where_the_weights_end():
    cameras = ring(12)[[0]]
    view = render_view(photograph(cameras), BALL, camera_at(45, "t", 96), RenderConfig(cameras=1))
    rows = view.error[48]
    # The camera is at the left: the ball's right rim is turned away from it.
    assert rows[view.mask[48] > 0][0] == 0 and rows[view.mask[48] > 0][-1] == 1


@pytest.mark.parametrize(("weight", "missing"), [(0.0, 1.0), (0.9e-5, 1.0), (1e-5, 0.0), (1.1e-5, 0.0), (1.0, 0.0)])
def test_a_pixel_is_seen_from_a_hundred_thousandth_on(weight, missing):
    blend = Blend(torch.zeros(3, 1, 1), torch.full((2, 1, 1), weight / 2), torch.zeros(1, 1))
    assert error_rule("unseen")(Evidence(mask=torch.ones(1, 1), depth=torch.ones(1, 1), blend=blend)).item() == missing


def test_all_asks_for_the_subject_with_its_rim_and_keeps_its_colours():
    cameras = ring(12)[[0]]
    frame, target = photograph(cameras), camera_at(45, "t", 96)
    unseen = render_view(frame, BALL, target, RenderConfig(cameras=1))
    whole = render_view(frame, BALL, target, RenderConfig(cameras=1, error_rule="all"))
    covered = whole.mask > 0
    near = torch.stack([covered.roll((y, x), (0, 1)) for y in range(-2, 3) for x in range(-2, 3)]).any(0)
    assert torch.equal(whole.error, near.float()) and int(near.sum()) > int(covered.sum()) + 200
    assert not bool(unseen.error[~covered].any()), "the paper's E lies on the proxy"
    assert torch.equal(whole.rgb, unseen.rgb) and torch.equal(whole.weights, unseen.weights)


def test_an_unknown_rule_is_named():
    with pytest.raises(ValueError, match="expected an error rule among"):
        error_rule("unsen")


OWN_RULES = """
from viewmend import error_rule
unseen = error_rule("unseen")
soft = lambda evidence: unseen(evidence).clamp_min(0.5)
thrice = lambda evidence: 3 * unseen(evidence)
boolean = lambda evidence: unseen(evidence) > 0
rows = lambda evidence: unseen(evidence)[1:]
nothing = lambda evidence: 0 * unseen(evidence)
no_number = lambda evidence: unseen(evidence) / 0
none = lambda evidence: None
"""


@pytest.mark.parametrize(
    ("name", "got"),
    [
        ("soft", None),
        ("thrice", "values from 0 to 3"),
        ("boolean", "torch.bool"),
        ("rows", r"float32 of shape \(95, 96\)"),
        ("nothing", r"less on \d+ pixels that no source view colours"),
        ("no_number", "values from nan"),
        ("none", "NoneType"),
        ("lost", "to be a class or a function, found none"),
    ],
)
def test_what_a_rule_of_ones_own_gives_is_looked_at(tmp_path, name, got):
    (tmp_path / "own.py").write_text(OWN_RULES)
    frame, target = photograph(ring(12)[[0]]), camera_at(45, "t", 96)
    if got is not None:
        with pytest.raises(ValueError, match=got):
            render_view(frame, BALL, target, RenderConfig(cameras=1, error_rule=f"{tmp_path / 'own.py'}:{name}"))
        return
    view = render_view(frame, BALL, target, RenderConfig(cameras=1, error_rule=f"{tmp_path / 'own.py'}:{name}"))
    unseen = render_view(frame, BALL, target, RenderConfig(cameras=1)).error
    assert torch.equal(view.error, unseen.clamp_min(0.5)) and 0 < float(unseen.mean()) < 1


def test_excluded_cameras_leave_no_trace():
    frame, target = photograph(ring(6)), camera_at(60, "t")
    config = RenderConfig()
    marked = frame.rgb.clone()
    marked[1] = 255
    with_it = render_view(replace(frame, rgb=marked), BALL, target, config)
    assert "c1" in with_it.source_views
    without = render_view(replace(frame, rgb=marked), BALL, target, config, exclude=("c1",))
    alone = render_view(frame.without(["c1"]), BALL, target, config)
    assert set(without.source_views) == set(alone.source_views)
    torch.testing.assert_close(without.rgb, alone.rgb)
    assert without.candidate_views == alone.candidate_views
    assert without.silhouettes.cameras.names == alone.silhouettes.cameras.names == ("c0", "c2", "c3", "c4", "c5")
    assert torch.equal(without.silhouettes.mask, alone.silhouettes.mask)
    with pytest.raises(ValueError, match="all of them excluded"):
        render_view(frame, BALL, target, config, exclude=frame.cameras.names)


def test_an_empty_proxy_gives_an_empty_view():
    empty = replace(BALL, mesh=Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32)), normals=torch.zeros(0, 3))
    view = render_view(photograph(ring(4)), empty, camera_at(5, "t"), RenderConfig())
    assert view.mask.sum() == 0 and view.error.sum() == 0 and view.rgb.sum() == 0
    assert view.source_views[0] == "c0"
