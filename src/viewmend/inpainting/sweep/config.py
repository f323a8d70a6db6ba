"""The sizes of the reader of whole views."""

from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, get_args

OFFSETS = (-0.012, 0.0, 0.008, 0.016, 0.026, 0.038, 0.053, 0.073, 0.1, 0.14, 0.19, 0.26, 0.36, 0.5)
"""Where a ray is looked at: z-depth behind the proxy, in subject sizes."""

CoarseFillName = Literal["smooth", "rays"]


@dataclass(frozen=True, kw_only=True)
class SweepConfig:
    """One architecture of `SweepNet`."""

    num_views: int = 8
    """Cameras at the view's own time that are looked at: the source views, then the closest others."""
    width: int = 24
    """Hidden size where cameras are weighed at a place: the only layers that are run for each camera."""
    place_channels: int = 12
    """What is kept of each place of a ray."""
    features: int = 48
    """Channels of the convolutions at half the resolution; coarser scales have more."""
    fine_features: int = 32
    """Channels of the convolutions at full resolution."""
    error_features: int = 0
    """Channels of the `ErrorNet`; 0 for a model without."""
    coarse_fill: CoarseFillName = "smooth"
    """What holes may show beside the cameras: what `SmoothFill` or `RayBlendNet` makes of them, not trained here."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for config.json."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "SweepConfig":
        """Inverse of `to_dict`.

        Raises:
            ValueError: a key is unknown, a size is no positive whole number, or there is no such fill.
        """
        unknown = sorted(set(values) - {f.name for f in fields(cls)})
        fills = get_args(CoarseFillName)
        if values.get("coarse_fill", fills[0]) not in fills:
            raise ValueError(f"expected coarse_fill among {list(fills)}, got {values['coarse_fill']!r}")
        sizes = {name: value for name, value in values.items() if name != "coarse_fill"}
        least = {"error_features": 0}
        wrong = [n for n, size in sizes.items() if type(size) is not int or not least.get(n, 1) <= size <= 1024]
        if unknown or wrong:
            raise ValueError(
                f"expected whole numbers of {[f.name for f in fields(cls)]}, got {unknown or wrong}; was this written "
                "by a newer version?"
            )
        return cls(**values)
