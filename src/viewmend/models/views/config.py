"""Sizes of the default model, and the layout of the ray samples that its networks are trained on."""

from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, Literal

from msgspec import Meta

from viewmend.utils.untrusted_input import typed

OFFSETS = (-0.012, 0.0, 0.008, 0.016, 0.026, 0.038, 0.053, 0.073, 0.1, 0.14, 0.19, 0.26, 0.36, 0.5)
"""The depth hypotheses of a ray: z-depth behind the proxy (negative: in front), in subject sizes
(`SceneScale.size_m`)."""
RAY_VIEWS = 4
"""A ray is sampled in this many of the source cameras: those near the viewer that see the proxy's surface."""
NUM_FEATURES = 18
"""A ray sample has this many features per camera: the 14 of `CameraFeatures`, RGB minus the
cameras' mean, and the prior weight."""
COLOUR = slice(0, 3)
"""These features of a ray sample are the camera's RGB on black."""
RGBA = slice(0, 4)
"""These features of a ray sample are the camera's RGB on black, and its mask."""
IN_VIEW = 8
"""This feature of a ray sample is 1 if the camera has the sample in view, else 0."""
NUM_STATISTICS = 10
"""A ray sample has this many statistics over cameras; `RayStatistics` names them."""
NEAR = 0.03
"""The fine distance behind the proxy saturates at this scale, in subject sizes."""
FAR = 0.2
"""The coarse distance behind the proxy saturates at this scale, in subject sizes."""
CONTRAST = 10.0
"""Variances of colours are multiplied by this factor, because they are small numbers."""
AROUND = 0.06
"""Images are averaged around a sample over squares of this side, in subject sizes."""

Size = Annotated[int, Meta(ge=1, le=1024)]


class Sizes:
    """Conversion of a config dataclass from and to the values in config.json."""

    def to_dict(self: Any) -> dict[str, Any]:
        """Plain values, for config.json."""
        return asdict(self)

    @classmethod
    def from_dict(cls: Any, values: dict[str, Any]) -> Any:
        """Inverse of `to_dict`. Raises ValueError for an unknown key or an impossible value."""
        names = [field.name for field in fields(cls)]
        unknown = sorted(set(values) - set(names))
        if unknown:
            raise ValueError(
                f"expected keys among {names}, got {unknown}; use the version of viewmend that wrote them"
            )
        return typed(values, cls)


@dataclass(frozen=True, kw_only=True)
class ViewsConfig(Sizes):
    """One architecture of `ViewSynthNet`."""

    num_views: Size = 8
    """Source cameras per view: those that coloured it, then the closest others."""
    width: Size = 24
    """Hidden size of the sample aggregation: the only layers that run once per camera."""
    sample_channels: Size = 12
    """Features kept of each ray sample."""
    features: Size = 48
    """Channels of the U-Net at half the resolution; coarser scales have more."""
    fine_features: Size = 32
    """Channels of the convolutions at full resolution."""
    error_features: Annotated[int, Meta(ge=0, le=1024)] = 0
    """Channels of the `ErrorPredictor`; 0 for a model without one."""
    coarse_fill: Literal["smooth", "rays"] = "smooth"
    """How holes are filled before the prediction: smoothly, or by a trained `RayFill` with fixed weights."""


@dataclass(frozen=True, kw_only=True)
class RaysConfig(Sizes):
    """One architecture of `RayFill`."""

    num_views: Size = 8
    """Source cameras per view: those that coloured it, then the closest others."""
    width: Size = 32
    """Hidden size where cameras are compared at a sample; the head's width is a multiple of it."""
