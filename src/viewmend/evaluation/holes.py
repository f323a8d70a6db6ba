"""How well holes are filled: a camera is left out, its view rendered, mended as a stream, and compared (section 10)."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from viewmend.geometry.bounds import Bounds
from viewmend.inpainting.protocol import ViewInpainter
from viewmend.metrics.view_scores import ENOUGH_HOLE_PX, ViewScores, mean_over_frames, score_view
from viewmend.pipeline import PipelineConfig, StreamState, mend_view, observe
from viewmend.views import MultiViewFrame

FOREGROUND = 128
"""A true mask from here on (of 255) is subject."""


@dataclass(frozen=True)
class SceneScores:
    """PSNR in dB of one scene by one method: means over frames with at least 50 such pixels; None without any."""

    scene: str
    method: str
    holes: float | None
    """Over the pixels of E."""
    holes_fg: float | None
    """Over those inside the true mask."""
    whole: float | None
    hole_px: int
    """Pixels of E, all frames together."""


def leave_one_out(
    scene: str,
    frames: Iterable[tuple[MultiViewFrame, MultiViewFrame]],
    bounds: Bounds | None,
    inpainters: Mapping[str, ViewInpainter],
    config: PipelineConfig,
) -> list[SceneScores]:
    """Stream the held camera's view through every inpainter, one frame at a time, past frames only.

    Args:
        scene: what the scores call it.
        frames: pairs of the rig's frame and the held camera's truth at that time (one view, with its mask).
        bounds: the volume that may hold the subject, None to find it.
        inpainters: by the name of the method; all complete the same rendered views.
        config: the system around them.
    """
    states = {name: StreamState(inpainter.initial_state()) for name, inpainter in inpainters.items()}
    scores: dict[str, list[ViewScores]] = {name: [] for name in inpainters}
    for frame, truth in frames:
        assert truth.mask is not None, "a held camera comes with its mask"
        observation = observe(frame.without(truth.cameras.names), bounds, config)
        target = truth.rgb[0].float() / 255 * (truth.mask[0].float() / 255)
        for name, inpainter in inpainters.items():
            mended = mend_view(observation, truth.cameras, states[name], inpainter, config)
            states[name] = mended.state
            completed = mended.completed
            scores[name].append(score_view(completed.view, completed.rgb, target, truth.mask[0] >= FOREGROUND))
    return [_scene(scene, name, of) for name, of in scores.items()]


def _scene(scene: str, method: str, scores: Sequence[ViewScores]) -> SceneScores:
    return SceneScores(
        scene,
        method,
        mean_over_frames([s.psnr_holes for s in scores if s.holes_px >= ENOUGH_HOLE_PX]),
        mean_over_frames([s.psnr_holes_fg for s in scores if s.holes_fg_px >= ENOUGH_HOLE_PX]),
        mean_over_frames([s.psnr_whole for s in scores]),
        sum(s.holes_px for s in scores),
    )
