"""Sizes of the default model, and the layout of the ray samples that its networks are trained on."""

from dataclasses import asdict, dataclass, fields
from typing import Annotated, Any, Literal

from msgspec import Meta

from viewmend.utils.untrusted_input import typed

OFFSETS = (-0.012, 0.0, 0.008, 0.016, 0.026, 0.038, 0.053, 0.073, 0.1, 0.14, 0.19, 0.26, 0.36, 0.5)
"""Depth hypotheses of a ray: z-depth behind the proxy, in subject sizes."""
FEATURES = 18
"""Features of a ray sample in one camera: the 14 of `CameraFeatures`, RGB minus the cameras' mean, and prior weight."""
COLOUR, MASK, IN_VIEW = slice(0, 3), slice(3, 4), 8
STATISTICS = 10
"""Statistics of a ray sample over cameras: mean RGB, variance of RGB, the two smallest masks of the rig, and the two
smallest masks averaged around the sample."""
NEAR, FAR = 0.03, 0.2
"""Scales of the fine and the coarse distance behind the proxy, in subject sizes."""
CONTRAST = 10.0
"""Factor on variances of colours, which are small numbers."""
AROUND = 0.06
"""Side of the squares over which images are averaged around a sample, in subject sizes."""

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
        if unknown := sorted(set(values) - set(names)):
            raise ValueError(f"expected keys among {names}, got {unknown}; use the version of viewmend that wrote them")
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
    """First guess for holes: a smooth fill, or a trained `RayFill` whose weights stay fixed."""


@dataclass(frozen=True, kw_only=True)
class RaysConfig(Sizes):
    """One architecture of `RayFill`."""

    num_views: Size = 8
    """Source cameras per view: those that coloured it, then the closest others."""
    width: Size = 32
    """Hidden size where cameras are compared at a sample; the head's width is a multiple of it."""
