"""Sizes and options of the paper's transformer."""

from dataclasses import asdict, dataclass, fields, replace
from typing import Any, get_args

from viewmend.models.compositing import Background
from viewmend.utils.untrusted_input import typed

ENCODER_GROUPS = (1, 1, 1, 1, 1, 2, 4, 8, 1)
"""Groups of the encoder's nine convolutions."""
SMALL_WIDTHS = (16, 16, 32, 64, 96, 128, 96, 64, 32)
"""Encoder widths of `paper_small`: a quarter of the paper's."""
PAPER_TOP_K = 512
"""Tokens kept by pruning: about an eighth of a whole window of three cameras at 512 pixels, with
0.00 dB less than all of them in the ablation."""
MAX_SIZE = 65_536
"""The largest accepted size, so that a damaged config cannot request an absurd allocation."""
MAX_BLOCKS = 256


@dataclass(frozen=True, kw_only=True)
class PaperConfig:
    """One architecture of `PatchTransformer`. The defaults are the paper's model, without pruning."""

    widths: tuple[int, ...] = (64, 64, 128, 256, 384, 512, 384, 256, 128)
    """Output channels of the encoder's nine convolutions; the last is C, the channels of a patch."""
    dim: int = 512
    """D, the size of a token."""
    heads: int = 8
    """Attention heads."""
    groups: int = 2
    """n_g, groups of blocks; each prunes its context once."""
    blocks: int = 4
    """n_b, blocks in a group."""
    ffn_ratio: int = 4
    """Hidden size of a block's feed-forward network, as a multiple of `dim`."""
    use_mask: bool = True
    """False: no matting, no pruning of background patches, and no mask in the encoder input (Table 3)."""
    use_depth: bool = True
    """False: omit the proxy's depth, relative to its median, from the encoder input."""
    background: Background = "white"
    """Background of all images: white as in the paper, or black."""
    rope: bool = True
    """False: omit the rotary embedding of (u, v, s) from the attention scores."""
    top_k: int | None = None
    """Context tokens kept by pruning, in training too; None keeps all. `RenderQuality.top_k` overrides it."""
    num_source_views: int = 3
    """Cameras in the context, the closest first, however many coloured the view."""
    n_c: int = 3
    """Context frames just before the current one."""
    n_w: int = 3
    """Context frames further back."""
    k_w: int = 10
    """Spacing of the frames further back."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "widths", tuple(self.widths))
        least = dict.fromkeys(("dim", "heads", "groups", "blocks", "ffn_ratio", "num_source_views", "k_w"), 1)
        least |= {"n_c": 0, "n_w": 0}
        wrong = [
            f"{n} = {getattr(self, n)}" for n, low in least.items() if not low <= getattr(self, n) <= MAX_SIZE
        ]
        wrong += [f"widths of {width}" for width in self.widths if not 0 < width <= MAX_SIZE]
        wrong += [f"top_k = {self.top_k}"] if self.top_k is not None and self.top_k < 1 else []
        if wrong:
            raise ValueError(f"expected positive sizes of at most {MAX_SIZE}, got {', '.join(wrong)}")
        if self.groups * self.blocks > MAX_BLOCKS:
            raise ValueError(
                f"expected at most {MAX_BLOCKS} blocks in total, got {self.groups} x {self.blocks}"
            )
        if self.dim % (16 * self.heads):
            raise ValueError(
                f"expected dim to be a multiple of 16 x heads (three axes of rotated pairs), got dim {self.dim} "
                f"with {self.heads} heads; change one of them"
            )
        if len(self.widths) != len(ENCODER_GROUPS) or any(w % 8 for w in self.widths):
            raise ValueError(
                f"expected {len(ENCODER_GROUPS)} encoder widths, multiples of 8, got {self.widths}"
            )
        if self.background not in get_args(Background):
            raise ValueError(f"expected background 'black' or 'white', got {self.background!r}")

    @property
    def in_channels(self) -> int:
        """Channels of the encoder's input."""
        return 3 + self.use_mask + self.use_depth

    @property
    def total_blocks(self) -> int:
        """Blocks of all groups."""
        return self.groups * self.blocks

    @property
    def window(self) -> int:
        """Frames that the temporal window spans, by which s is normalised: k_w n_w, or n_c if greater (section 5)."""
        return max(self.k_w * self.n_w, self.n_c, 1)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for config.json."""
        return asdict(self) | {"widths": list(self.widths)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "PaperConfig":
        """Inverse of `to_dict`. Raises ValueError for an unknown key or an impossible value."""
        unknown = sorted(set(values) - {f.name for f in fields(cls)})
        if unknown:
            raise ValueError(
                f"expected the keys of PaperConfig, got unknown {unknown}; use the version that wrote it"
            )
        return typed(values, cls)


def paper() -> PaperConfig:
    """The paper's model: FuseFormer's encoder widths, D = 512, 8 heads, 2 groups of 4 blocks.

    The paper does not state k of its pruning; here it is `PAPER_TOP_K`.
    """
    return PaperConfig(top_k=PAPER_TOP_K)


def paper_small() -> PaperConfig:
    """The paper's model with a quarter of its encoder's widths and half of its D, trainable on two CPU cores."""
    return replace(paper(), widths=SMALL_WIDTHS, dim=256)
