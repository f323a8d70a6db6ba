"""E2FGVI's flow-guided propagation: features travel from frame to frame, backward in time and then forward."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from einops import repeat
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.contrib.baselines.deformable_convolution import deform_conv2d
from viewmend.contrib.baselines.spynet import warp

GROUPS = 16
"""Groups of channels with offsets of their own."""
POINTS = 9
"""Points of a 3 x 3 kernel."""
REACH_PX = 10.0
"""How far a kernel point may move away from where the flow leads."""

Feature = Float[Tensor, "sample channel height width"]
Flow = Float[Tensor, "sample 2 height width"]


@dataclass(frozen=True)
class Propagated:
    """What one direction hands on from frame to frame: the last two results and the flows between them."""

    features: tuple[Feature, ...] = ()
    """At most two results, the latest last."""
    flow: Flow | None = None
    """The flow from the latest frame to the one before it, once there are two."""


class AlignedConvolution(nn.Module):
    """Brings two earlier results to the current frame: deformable, led by flow, corrected by what the features say."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(channels, 2 * channels, 3, 3))
        self.bias = nn.Parameter(torch.zeros(channels))
        layers: list[nn.Module] = []
        for inputs in (3 * channels + 4, channels, channels):
            layers += [nn.Conv2d(inputs, channels, 3, padding=1), nn.LeakyReLU(0.1)]
        self.conv_offset = nn.Sequential(*layers, nn.Conv2d(channels, 3 * GROUPS * POINTS, 3, padding=1))

    def initialise(self) -> None:
        """Fresh weights as the authors draw them: at first, kernel points are where the flow leads."""
        nn.init.normal_(self.weight, 0, 0.02)
        nn.init.zeros_(self.bias)
        last = self.conv_offset[-1]
        assert isinstance(last, nn.Conv2d)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias if last.bias is not None else self.bias)

    def forward(
        self,
        earlier: Float[Tensor, "sample channels2 height width"],
        current: Float[Tensor, "sample channels3 height width"],
        flow1: Flow,
        flow2: Flow,
    ) -> Feature:
        """Two results side by side, what the frames say of them, and the flows to each."""
        raw = self.conv_offset(torch.cat([current, flow1, flow2], 1))
        offsets, masks = raw.float().split([2 * GROUPS * POINTS, GROUPS * POINTS], 1)
        # Flows are (right, down); the offsets of a kernel point (down, right).
        led = [repeat(flow.flip(1), "b yx h w -> b (n yx) h w", n=GROUPS * POINTS // 2) for flow in (flow1, flow2)]
        offsets = REACH_PX * offsets.tanh() + torch.cat(led, 1)
        return deform_conv2d(earlier, offsets, masks.sigmoid(), self.weight, self.bias)


class Propagation(nn.Module):
    """Second-order propagation in both directions; the forward one also sees what the backward one found."""

    def __init__(self, channels: int = 128) -> None:
        super().__init__()
        self.deform_align = nn.ModuleDict({way: AlignedConvolution(channels) for way in ("backward_", "forward_")})
        self.backbone = nn.ModuleDict(
            {
                way: nn.Sequential(
                    nn.Conv2d(inputs * channels, channels, 3, padding=1),
                    nn.LeakyReLU(0.1),
                    nn.Conv2d(channels, channels, 3, padding=1),
                )
                for way, inputs in (("backward_", 2), ("forward_", 3))
            }
        )
        self.fusion = nn.Conv2d(2 * channels, channels, 1)

    def forward(
        self,
        features: Float[Tensor, "sample frame channel height width"],
        to_next: Float[Tensor, "sample pair 2 height width"],
        to_previous: Float[Tensor, "sample pair 2 height width"],
    ) -> Float[Tensor, "sample frame channel height width"]:
        """Features of consecutive frames, given the flow of each pair, (right, down) in their pixels."""
        frames = features.unbind(1)
        # The published networks were trained with the pairs' flows in the order of time here too, although this sweep
        # meets the last pair first; in any other order their weights compute something else.
        backward = self._sweep("backward_", [(x,) for x in reversed(frames)], to_next.unbind(1))
        known = list(zip(frames, reversed(backward), strict=True))
        forward = self._sweep("forward_", known, to_previous.unbind(1))
        return torch.stack([self._fuse(x, back, ahead) for (x, back), ahead in zip(known, forward, strict=True)], 1)

    def follow(self, current: Feature, flow: Flow | None, state: Propagated) -> tuple[Feature, Propagated]:
        """The latest frame of a stream by itself: the forward sweep goes on, the backward one starts here.

        Args:
            current: the frame's features.
            flow: from this frame to the one before, None at the first.
            state: what this method returned there.
        """
        backward, _ = self.step("backward_", (current,), None, Propagated())
        forward, state = self.step("forward_", (current, backward), flow, state)
        return self._fuse(current, backward, forward), state

    def _fuse(self, current: Feature, backward: Feature, forward: Feature) -> Feature:
        return current + self.fusion(torch.cat([backward, forward], 1))

    def _sweep(self, way: str, known: Sequence[tuple[Feature, ...]], flows: Sequence[Flow]) -> list[Feature]:
        state, results = Propagated(), []
        for number, seen in enumerate(known):
            result, state = self.step(way, seen, flows[number - 1] if number else None, state)
            results.append(result)
        return results

    def step(
        self, way: str, seen: tuple[Feature, ...], flow: Flow | None, state: Propagated
    ) -> tuple[Feature, Propagated]:
        """One frame further: the result at a frame, and what the next one needs.

        Args:
            way: "backward_" or "forward_".
            seen: the frame's own features first, then what other directions found in it.
            flow: from this frame to the one stepped from, None at the first.
            state: what the last step returned.
        """
        current = seen[0]
        result = torch.zeros_like(current)
        if flow is not None:
            last = state.features[-1]
            if state.flow is None:
                earlier, flow2 = torch.zeros_like(last), torch.zeros_like(flow)
                warped2 = earlier
            else:
                earlier = state.features[-2]
                flow2 = flow + warp(state.flow, flow)
                warped2 = warp(earlier, flow2)
            around = torch.cat([warp(last, flow), current, warped2], 1)
            result = self.deform_align[way](torch.cat([last, earlier], 1), around, flow, flow2)
        result = result + self.backbone[way](torch.cat([*seen, result], 1))
        return result, Propagated((*state.features[-1:], result), flow)
