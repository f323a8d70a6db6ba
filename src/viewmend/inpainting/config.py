"""The sizes and switches of the inpainter."""

from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal

from viewmend.json_input import typed

ENCODER_GROUPS = (1, 1, 1, 1, 1, 2, 4, 8, 1)
"""Groups of the encoder's nine convolutions."""
SMALL_WIDTHS = (16, 16, 32, 64, 96, 128, 96, 64, 32)
"""A quarter of the paper's."""
PAPER_TOP_K = 512
"""About an eighth of what a whole window of three cameras shows at 512 pixels; 0.00 dB below all in the ablation."""
LARGEST = 65_536
"""The largest size; what a file claims is not allocated blindly."""
MAX_BLOCKS = 256
CHOICES = {
    "coarse_fill": ("none", "smooth", "rays"),
    "background": ("black", "white", "recorded"),
    "patch_depth": ("pixel", "centre"),
    "past_geometry": ("own", "current"),
    "rope_unit": ("image", "patch"),
}


@dataclass(frozen=True, kw_only=True)
class InpainterConfig:
    """One architecture; `paper()` and `small()` are two of them. Defaults are the paper's sizes, with what is ours."""

    widths: tuple[int, ...] = (64, 64, 128, 256, 384, 512, 384, 256, 128)
    """Output channels of the encoder's nine convolutions; the last is C, the channels of a patch."""
    dim: int = 512
    """D, the size of a token."""
    heads: int = 8
    groups: int = 2
    """n_g, groups of blocks; each prunes its context once."""
    blocks: int = 4
    """n_b, blocks in a group."""
    ffn_ratio: int = 4
    """Hidden size of a block's feed-forward network, in tokens."""
    use_mask: bool = True
    """Show the encoder the foreground mask (the paper loses 5.6 dB in the holes without)."""
    use_depth: bool = True
    """Show the encoder the proxy's depth, relative to the image's median depth (so it fits any rig)."""
    use_validity: bool = True
    """Show the encoder where a view is right (1 - E), so that a hole is no black cloth. Ours."""
    background: Literal["black", "white", "recorded"] = "black"
    """What lies behind the subject: black, as in a rendered view (ours); white, upon which holes are black and the
    model paints (the paper's); or in camera images what they recorded, and black in the view (ours)."""
    min_foreground: float = 0.1
    """A camera's mask up to this, in [0, 1], is background: 0 (the paper's), or more, since recorded masks are never
    quite zero."""
    rope: bool = True
    """Rotary embedding of (u, v, s) in the attention's scores."""
    rope_unit: Literal["image", "patch"] = "image"
    """What (u, v) are measured in for the scores: the novel view's width and height (the paper's), or patches, 20 of
    which count as one (the patches of a 320 pixel image), so that a model trained on small images fits large ones."""
    rope_values: bool = False
    """Rotate values by the offset between context patch and query as well, so that what is copied knows how far
    it must shift. Ours."""
    colour_skip: bool = False
    """Let patches carry their colours at 1/4 besides their features, as waves that start out as a copy. Ours."""
    coarse_fill: Literal["none", "smooth", "rays"] = "none"
    """What fills the holes before the patch transformer: nothing (the paper's), a smooth fill from the surroundings, or
    `RayBlendNet`. The encoder is shown the coarse fill instead of black, the decoder the view's own pixels, and it
    decides pixel by pixel how much of the fill to replace. Ours."""
    num_ray_views: int = 8
    """Cameras at the view's own time that `RayBlendNet` looks at: the source views, then the closest others."""
    temporal_accumulation: float = 0.0
    """Weight of a stream's last fill, carried by the proxy, where the new one hardly differs; 0 to below 1. Ours."""
    identity_init: bool = True
    """Start attention at what lands nearest, and tokens as copies of it, instead of at random. Ours."""
    token_norms: bool = True
    """Normalise tokens where patches become tokens, and before they are decoded. Ours."""
    top_k: int | None = None
    """Context tokens that survive pruning, in training, too; None keeps all. A step may ask for another number."""
    context_cameras: int | None = None
    """How many cameras are context, whatever number coloured the view; None: those that did."""
    past_geometry: Literal["own", "current"] = "own"
    """Geometry that carries a past patch into the view: that of its own time, or of now (the paper's)."""
    patch_depth: Literal["pixel", "centre"] = "pixel"
    """Depth of a patch: of the pixel below and right of its centre, or the mean about the centre (the paper's)."""
    n_c: int = 3
    """Frames just before the current one."""
    n_w: int = 3
    """Frames further back."""
    k_w: int = 10
    """Spacing of the frames further back."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", tuple(self.widths))
        least = dict.fromkeys(("dim", "heads", "groups", "blocks", "ffn_ratio", "k_w", "num_ray_views"), 1)
        least |= {"n_c": 0, "n_w": 0}
        wrong = [f"{n} = {getattr(self, n)}" for n, low in least.items() if not low <= getattr(self, n) <= LARGEST]
        wrong += [f"widths of {width}" for width in self.widths if not 0 < width <= LARGEST]
        if wrong:
            raise ValueError(f"expected positive sizes of at most {LARGEST}, got {', '.join(wrong)}")
        if self.groups * self.blocks > MAX_BLOCKS:
            raise ValueError(f"expected at most {MAX_BLOCKS} blocks in all, got {self.groups} x {self.blocks}")
        if self.dim % (16 * self.heads):
            raise ValueError(
                f"expected dim to be a multiple of 16 x heads (three axes of rotated pairs), got dim {self.dim} "
                f"with {self.heads} heads; change one of them"
            )
        if len(self.widths) != len(ENCODER_GROUPS) or any(w % 8 for w in self.widths):
            raise ValueError(f"expected {len(ENCODER_GROUPS)} encoder widths, multiples of 8, got {self.widths}")
        if not 0 <= self.temporal_accumulation < 1:
            raise ValueError(f"expected temporal_accumulation from 0 to below 1, got {self.temporal_accumulation}")
        if not 0 <= self.min_foreground < 1:
            raise ValueError(f"expected min_foreground from 0 to below 1, got {self.min_foreground}")
        for name, known in CHOICES.items():
            if getattr(self, name) not in known:
                listed = f"{', '.join(known[:-1])} or {known[-1]}"
                raise ValueError(f"expected {name} {listed}, got '{getattr(self, name)}'")
        for name in ("top_k", "context_cameras"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ValueError(f"expected {name} of at least 1 or none, got {value}")

    @property
    def in_channels(self) -> int:
        """Channels of the encoder's input."""
        return 3 + self.use_mask + self.use_depth + self.use_validity

    @property
    def patch_channels(self) -> int:
        """Channels of the map that is cut into patches."""
        return self.widths[-1] + self.in_channels * self.colour_skip

    @property
    def total_blocks(self) -> int:
        """Blocks of all groups."""
        return self.groups * self.blocks

    @property
    def window(self) -> int:
        """k_w n_w, the frames that the relative window spans, which also scales time to s; at least 1."""
        return max(self.k_w * self.n_w, self.n_c, 1)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for config.json."""
        return asdict(self) | {"widths": list(self.widths)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "InpainterConfig":
        """Inverse of `to_dict`; what a config does not name yet has its default, which is as it was before.

        Names of earlier versions (`prefill`, `rays`, `steady`, `colour_path`, `copier_start`, `black_background`) are
        read as what they are called now.

        Raises:
            ValueError: a key is unknown, or a value is impossible.
        """
        values = _renamed(values)
        unknown = sorted(set(values) - {f.name for f in fields(cls)})
        if unknown:
            raise ValueError(
                f"expected the keys of InpainterConfig, unknown {unknown}; was this written by a newer version?"
            )
        return typed(values, cls)


def _renamed(values: dict[str, Any]) -> dict[str, Any]:
    """The values by the names of today.

    Raises:
        ValueError: a switch that is gone was not at its default.
    """
    values = dict(values)
    for name, only in (("attention_scale", "model"), ("grid", "relative")):
        if values.pop(name, only) != only:
            raise ValueError(f"expected {name} '{only}', the only one left, got another; train the model anew")
    values.pop("clamp_fill", None)  # it changed nothing that was shown
    for old, new in (
        ("colour_path", "colour_skip"),
        ("steady", "temporal_accumulation"),
        ("copier_start", "identity_init"),
    ):
        if old in values:
            values[new] = values.pop(old)
    if "black_background" in values:
        values["background"] = "black" if values.pop("black_background") else "recorded"
    rays = values.pop("rays", 0)
    if values.pop("prefill", False):
        values |= {"coarse_fill": "rays", "num_ray_views": rays} if rays else {"coarse_fill": "smooth"}
    return values


def paper() -> InpainterConfig:
    """The paper's model: encoder of FuseFormer's widths, D = 512, 8 heads, 2 groups of 4 blocks, nothing of ours.

    The paper does not state k of its pruning: here it is `PAPER_TOP_K`.
    """
    return InpainterConfig(
        use_validity=False,
        background="white",
        min_foreground=0.0,
        identity_init=False,
        token_norms=False,
        top_k=PAPER_TOP_K,
        context_cameras=3,
        past_geometry="current",
        patch_depth="centre",
    )


def paper_small() -> InpainterConfig:
    """The paper's model, nothing of ours, at the widths of `small`: for two CPU cores."""
    return replace(paper(), widths=SMALL_WIDTHS, dim=128, heads=4)


def small() -> InpainterConfig:
    """About a quarter of the paper's widths: for two CPU cores."""
    return InpainterConfig(
        widths=SMALL_WIDTHS,
        dim=128,
        heads=4,
        rope_unit="patch",
        rope_values=True,
        colour_skip=True,
        coarse_fill="rays",
        temporal_accumulation=0.7,
    )


def base() -> InpainterConfig:
    """The paper's widths with all of our additions, 35 M parameters: for a data-centre GPU."""
    return InpainterConfig(
        rope_unit="patch", rope_values=True, colour_skip=True, coarse_fill="rays", temporal_accumulation=0.7
    )
