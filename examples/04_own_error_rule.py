"""An error rule of your own: `python examples/04_own_error_rule.py` prints how much of a view each rule selects."""

import torch

from viewmend import (
    Evidence,
    RenderConfig,
    Stream,
    StreamConfig,
    Studio,
    StudioConfig,
    error_rule,
    make_method,
    orbit,
)

THRESHOLD = 0.05
"""Spread of the source cameras' colours, in [0, 1], above which a pixel counts as wrong."""


def disagreement(evidence: Evidence) -> torch.Tensor:
    """Error map (height, width): pixels without a source camera, and pixels whose source cameras disagree."""
    wrong = (evidence.blend.disagreement > THRESHOLD) * evidence.mask
    return torch.maximum(error_rule("holes")(evidence), wrong)


def selected(rule: str) -> float:
    """Share of the subject's pixels that a rule selects in a view of a synthetic scene."""
    studio = Studio(StudioConfig(seed=10003, cameras=6, frames=1, size_px=192))
    stream = Stream(
        make_method("unfilled"), StreamConfig(render=RenderConfig(error_rule=rule)), studio.bounds
    )
    stream.add_frame(studio.read(0))
    view = stream.render(orbit([0.5], (192, 192), elevation_rad=0.3))
    return float((view.error > 0).sum() / (view.mask > 0).sum())


if __name__ == "__main__":
    print({rule: round(selected(rule), 3) for rule in ("holes", "all", f"{__file__}:disagreement")})
