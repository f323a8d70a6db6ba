"""What the published networks' authors minimise: L1 in the holes and beside them, the hinge, and E2FGVI's flow."""

from copy import deepcopy
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import l1_loss

from viewmend.backgrounds import Background
from viewmend.baselines.e2fgvi import E2FGVI, LocalFlows
from viewmend.baselines.token_transformer import TokenTransformer
from viewmend.training.baseline_clips import FRAMINGS, TrainingClip, training_clip
from viewmend.training.losses import ImageLoss
from viewmend.training.objective import StepOutput
from viewmend.training.samples import Sample


@dataclass(frozen=True)
class BaselineOutput(StepOutput):
    """`completed` is each clip's last view."""

    flow: Float[Tensor, ""]
    """E2FGVI's term of completed flows; 0 of others."""
    clips: tuple[TrainingClip, ...]
    composed: tuple[Float[Tensor, "_time 3 _h _w"], ...]
    """Frames of each clip, in [-1, 1]: as they were rendered, and in the holes what the network made."""


class BaselineObjective(nn.Module):
    """L1 in the holes plus L1 beside them, each over its own pixels, plus E2FGVI's L1 of completed flows.

    The authors have a fixed SPyNet look at the true frames; here it is `start`'s, as training found it.
    """

    def __init__(
        self,
        model: TokenTransformer | E2FGVI,
        size_px: tuple[int, int],
        bfloat16: bool,
        start: nn.Module | None,
        background: Background = "black",
    ) -> None:
        super().__init__()
        self.background: Background = background
        self.model, self.size_px, self.autocast = model, size_px, bfloat16
        self.teacher = deepcopy(start).requires_grad_(False).eval() if isinstance(start, E2FGVI) else None

    def forward(self, batch: list[Sample]) -> BaselineOutput:
        """The terms of `batch`, each sample in a random framing."""
        clips = [
            training_clip(s, self.size_px, FRAMINGS[int(torch.randint(len(FRAMINGS), ()))], self.background)
            for s in batch
        ]
        made, flow_terms = zip(*(self._complete(clip) for clip in clips), strict=True)
        terms = [clip_terms(out, clip) for out, clip in zip(made, clips, strict=True)]
        inside, outside = (torch.stack(parts).mean() for parts in zip(*terms, strict=True))
        flow = torch.stack(flow_terms).mean()
        composed = tuple(
            torch.where(clip.holes[:, None], out, clip.frames) for out, clip in zip(made, clips, strict=True)
        )
        return BaselineOutput(
            image=ImageLoss(inside, outside, torch.zeros_like(inside)),
            flow=flow,
            total=inside + outside + flow,
            completed=tuple((images[-1] + 1) / 2 for images in composed),
            clips=tuple(clips),
            composed=composed,
        )

    def _complete(self, clip: TrainingClip) -> tuple[Float[Tensor, "time 3 height width"], Float[Tensor, ""]]:
        """The network's views of a clip, and the flow's term."""
        frames, count = torch.cat([clip.frames, clip.references])[None], len(clip.frames)
        with torch.autocast(frames.device.type, torch.bfloat16, enabled=self.autocast):
            if not isinstance(self.model, E2FGVI):
                return self.model(frames)[0, :count].float(), frames.new_zeros(())
            made, flows = self.model.with_flows(frames, count)
            flow = flow_term(flows, self._true_flows(clip)) if self.teacher is not None else frames.new_zeros(())
        return made[0, :count].float(), flow

    @torch.no_grad()
    def _true_flows(self, clip: TrainingClip) -> LocalFlows:
        assert self.teacher is not None
        return self.teacher.flows(clip.truth[None])


def clip_terms(
    made: Float[Tensor, "time 3 height width"], clip: TrainingClip
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """L1 in the holes over their share of the clip's pixels, and the same beside them; 0 where there are none."""
    difference, holes = (made - clip.truth).abs().mean(1), clip.holes.float()
    return tuple((difference * part).sum() / part.sum().clamp_min(1) for part in (holes, 1 - holes))  # pyright: ignore[reportReturnType]


def flow_term(flows: LocalFlows, true: LocalFlows) -> Float[Tensor, ""]:
    """Mean L1 of each direction's flow, added; 0 of a clip of one view, which has none."""
    if not flows.to_next.numel():
        return flows.to_next.sum()
    return l1_loss(flows.to_next, true.to_next) + l1_loss(flows.to_previous, true.to_previous)
