"""Error rules, and the error mask that a stream decides."""

import pytest
import torch
from reference.ball import camera_at, photograph, proxy, ring

from viewmend.geometry.hull import HullConfig
from viewmend.models.classical import Unfilled
from viewmend.rendering.blending import Blend
from viewmend.rendering.error_mask import Evidence, error_rule
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig

CUSTOM_RULES = """
from viewmend import error_rule
holes = error_rule("holes")
soft = lambda evidence: holes(evidence).clamp_min(0.5)
thrice = lambda evidence: 3 * holes(evidence)
boolean = lambda evidence: holes(evidence) > 0
rows = lambda evidence: holes(evidence)[1:]
nothing = lambda evidence: 0 * holes(evidence)
no_number = lambda evidence: holes(evidence) / 0
none = lambda evidence: None
unasked = lambda: None
demanding = lambda evidence, threshold: holes(evidence)
double = lambda evidence: holes(evidence).double()
half = lambda evidence: holes(evidence).half()
"""


def rendered(rule):
    """A view of the ball from one camera, by an error rule."""
    config = StreamConfig(hull=HullConfig(resolution=32), render=RenderConfig(cameras=1, error_rule=rule))
    stream = Stream(Unfilled(), config)
    stream.add_frame(photograph(ring(12)[[0]]), proxy())
    return stream.render(camera_at(45, "t", 96))


@pytest.mark.parametrize(
    ("weight", "missing"), [(0.0, 1.0), (0.9e-5, 1.0), (1e-5, 0.0), (1.1e-5, 0.0), (1.0, 0.0)]
)
def test_pixels_below_the_weight_threshold_are_holes(weight, missing):
    blend = Blend(torch.zeros(3, 1, 1), torch.full((2, 1, 1), weight / 2), torch.zeros(1, 1))
    assert (
        error_rule("holes")(Evidence(mask=torch.ones(1, 1), depth=torch.ones(1, 1), blend=blend)).item()
        == missing
    )


def test_rule_all_marks_the_subject_and_its_rim_and_keeps_colours():
    holes, whole = rendered("holes"), rendered("all")
    covered = whole.mask > 0
    near = torch.stack([covered.roll((y, x), (0, 1)) for y in range(-2, 3) for x in range(-2, 3)]).any(0)
    assert torch.equal(whole.error, near.float()) and int(near.sum()) > int(covered.sum()) + 200
    assert not bool(holes.error[~covered].any()), "the paper's E is part of the proxy"
    assert torch.equal(whole.rgb, holes.rgb) and torch.equal(whole.weights, holes.weights)


@pytest.mark.parametrize("fraction", [0.0, -1.0, 1.5, float("nan")])
def test_an_impossible_fraction_is_refused(fraction):
    with pytest.raises(ValueError, match="expected a refine_fraction above 0"):
        RenderConfig(refine_fraction=fraction)


@pytest.mark.parametrize(
    ("name", "got"),
    [
        ("thrice", "values from 0 to 3"),
        ("boolean", "torch.bool"),
        (
            "rows",
            r'float32 of shape .*; begin with torch\.maximum\(error_rule\("holes"\)\(evidence\), \.\.\.\)',
        ),
        ("nothing", r"less on \d+ pixels of holes"),
        ("no_number", "values from nan"),
        ("none", "NoneType"),
        ("unasked", r"unasked': expected a function of one argument, .* got parameters \(\); write def"),
        ("demanding", r"got parameters \(evidence, threshold\)"),
        ("lost", "to be a class or a function, found none"),
    ],
)
def test_the_result_of_a_custom_rule_is_checked(tmp_path, name, got):
    (tmp_path / "own.py").write_text(CUSTOM_RULES)
    with pytest.raises(ValueError, match=got):
        rendered(f"{tmp_path / 'own.py'}:{name}")


def test_a_custom_rule_decides_the_mask(tmp_path):
    (tmp_path / "own.py").write_text(CUSTOM_RULES)
    soft, holes = rendered(f"{tmp_path / 'own.py'}:soft"), rendered("holes")
    subject = holes.mask > 0
    assert (
        torch.equal(soft.error[subject], holes.error[subject].clamp_min(0.5))
        and 0 < float(holes.error.mean()) < 1
    )


@pytest.mark.parametrize("name", ["double", "half"])
def test_floats_of_a_custom_rule_become_float32(tmp_path, name):
    (tmp_path / "own.py").write_text(CUSTOM_RULES)
    error = rendered(f"{tmp_path / 'own.py'}:{name}").error
    assert error.dtype == torch.float32 and torch.equal(error, rendered("holes").error)
