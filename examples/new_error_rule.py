"""An error rule of your own: `python examples/new_error_rule.py` says how much more it asks to be mended."""

import torch

from viewmend import Evidence, RenderConfig, Stream, StreamConfig, error_rule, make_method
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig

THRESHOLD = 0.05
"""Spread of the source views' colours, in [0, 1], above which a pixel counts as wrong."""


def disagreement(evidence: Evidence) -> torch.Tensor:
    """E (height, width): what no source view colours, and where those that do disagree."""
    wrong = (evidence.blend.disagreement > THRESHOLD) * evidence.mask
    return torch.maximum(error_rule("unseen")(evidence), wrong)


def missing(rule: str) -> float:
    """Part of the subject's pixels that a rule asks to be mended, in a view of a scene made on the spot."""
    studio = Studio(StudioConfig(seed=10003, cameras=6, frames=1, size_px=192))
    stream = Stream(make_method("unfilled"), StreamConfig(render=RenderConfig(error_rule=rule)), studio.bounds)
    stream.push(studio.read(0))
    view = stream.render(orbit([0.5], (192, 192), elevation_rad=0.3))
    return float((view.error > 0).sum() / (view.mask > 0).sum())


if __name__ == "__main__":
    print({rule: round(missing(rule), 3) for rule in ("unseen", "all", f"{__file__}:disagreement")})
