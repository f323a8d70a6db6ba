"""The perceptual term, ours and a switch: L1 between VGG16's features inside the holes (Johnson et al. 2016).

The network is torchvision's `vgg16`, its weights a file that the user has: none come with this package, and without
them there is no such term.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from viewmend.inpainting.patches import crop
from viewmend.metrics.lpips import DEVIATION, MEAN, vgg16_layers
from viewmend.weight_files import WeightsError, read_weights

SEEN_BLOCKS = 4
"""Features are taken after the last ReLU of the first blocks: relu1_2, relu2_2, relu3_3, relu4_3."""
SEEN_LAYERS = 23
"""Up to there."""
CLASSIFIER = {0: (4096, 25088), 3: (4096, 4096), 6: (1000, 4096)}
"""Linear layers that a whole file has and nobody here needs."""
MARGIN_PX = 32
"""How much of a hole's surroundings the network is shown."""
CELL_PX = 2 ** (SEEN_BLOCKS - 1)
"""A feature of the last block seen covers so many pixels; crops are multiples of it."""
FILE = "vgg16-397923af.pth"
"""The name under which torchvision downloads its weights."""
NEXT = (
    "torchvision.models.vgg16(weights='IMAGENET1K_V1') downloads it, or give the path of a copy; "
    "or switch the perceptual term off"
)


class PerceptualWeightsError(ValueError):
    """VGG16's weights are missing, unreadable or another network's: what was expected, where, the next step."""


class Vgg16(nn.Module):
    """VGG16 (Simonyan & Zisserman 2015) up to relu4_3, keyed as torchvision's; frozen. `load_vgg16` makes it."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(*list(vgg16_layers())[:SEEN_LAYERS])

    def forward(self, rgb: Float[Tensor, "3 height width"]) -> list[Float[Tensor, "_channel _rows _cols"]]:
        """Features of an image in [0, 1] at 1/1, 1/2, 1/4 and 1/8 of its size."""
        mean, deviation = rgb.new_tensor((MEAN, DEVIATION))[:, :, None, None]
        x, seen = (rgb - mean) / deviation, []
        for layer in self.features:
            if isinstance(layer, nn.MaxPool2d):
                seen.append(x)
            x = layer(x)
        return [*seen, x]


def load_vgg16(path: Path | None = None, device: torch.device | str = "cpu") -> Vgg16:
    """VGG16 with the weights in this file, ready to compare.

    Args:
        path: a .safetensors file, or torch's own format (read with `weights_only`), with torchvision's keys; the
            classifier may be left out. None looks where torchvision downloads to.
        device: where it computes.

    Raises:
        PerceptualWeightsError: there is no such file, it cannot be read, or another network is in it.
    """
    path = Path(torch.hub.get_dir()) / "checkpoints" / FILE if path is None else path
    weights, expected = _read(path), _shapes()
    wrong = [f"{key} is missing" for key in expected if key.startswith("features.") and key not in weights]
    for key, weight in weights.items():
        if key not in expected:
            wrong.append(f"{key} is none of its")
        elif tuple(weight.shape) != expected[key]:
            wrong.append(f"{key} is {tuple(weight.shape)}, not {expected[key]}")
    if wrong:
        more = f" and {len(wrong) - 3} more" if len(wrong) > 3 else ""
        raise PerceptualWeightsError(
            f"{path}: expected the weights of torchvision's vgg16, got those of another network: "
            f"{'; '.join(wrong[:3])}{more}; {NEXT}"
        )
    # Built without numbers, so that there is no network but the one that was loaded.
    with torch.device("meta"):
        network = Vgg16()
    network.load_state_dict({key: weights[key].float() for key in network.state_dict()}, strict=True, assign=True)
    return network.requires_grad_(False).eval().to(device)


def perceptual_loss(
    network: Vgg16,
    predicted: Sequence[Float[Tensor, "3 _h _w"]],
    error: Sequence[Float[Tensor, "_h _w"]],
    truth: Sequence[Float[Tensor, "3 _h _w"]],
) -> Float[Tensor, ""]:
    """How far the features of E Ftilde + (1 - E) F* are from those of F* where E is, and its mean over a batch.

    The prediction is pasted into the truth, so that nothing but what it fills a hole with counts, and F* alone gives 0.
    Each layer's L1, the mean of its channels, is weighted by E's share of what a feature covers, |w d|_1 / |w|_1, and
    the four layers are averaged. Only a crop around the hole is looked at. No hole gives 0 with a zero gradient.
    """
    losses = [_in_holes(network, p.float(), E, t) for p, E, t in zip(predicted, error, truth, strict=True)]
    return torch.stack(losses).mean()


def _in_holes(network: Vgg16, predicted: Tensor, E: Tensor, truth: Tensor) -> Tensor:
    if not bool((E > 0).any()):
        return 0 * predicted.sum()
    top, left, size = _around(E)
    E, truth = crop(E[None], top, left, size)[0], crop(truth, top, left, size)
    pasted = truth + E * (crop(predicted, top, left, size) - truth)
    with torch.no_grad():
        expected = network(truth)
    losses = []
    for block, (seen, wanted) in enumerate(zip(network(pasted), expected, strict=True)):
        weight = avg_pool2d(E[None], 2**block)[0]
        losses.append((weight * (seen - wanted).abs().mean(0)).sum() / weight.sum())
    return torch.stack(losses).mean()


def _around(E: Tensor) -> tuple[int, int, tuple[int, int]]:
    """Top, left, height and width of what the network is shown of an image; it may leave it."""
    missing = (E > 0).nonzero()
    (top, left), (bottom, right) = missing.amin(0).tolist(), missing.amax(0).tolist()
    height, width = (-(-(extent + 1 + 2 * MARGIN_PX) // CELL_PX) * CELL_PX for extent in (bottom - top, right - left))
    return top - MARGIN_PX, left - MARGIN_PX, (height, width)


def _shapes() -> dict[str, tuple[int, ...]]:
    """The keys and shapes of a whole file of torchvision's."""
    with torch.device("meta"):
        layers = vgg16_layers().state_dict()
    shapes = {f"features.{key}": tuple(layer.shape) for key, layer in layers.items()}
    for number, shape in CLASSIFIER.items():
        shapes |= {f"classifier.{number}.weight": shape, f"classifier.{number}.bias": shape[:1]}
    return shapes


def _read(path: Path) -> dict[str, Tensor]:
    """The tensors in a file of either format."""
    if not path.is_file():
        raise PerceptualWeightsError(f"expected the weights of torchvision's vgg16 at {path}, got no such file; {NEXT}")
    try:
        return read_weights(path)
    except WeightsError as error:
        raise PerceptualWeightsError(f"{error}; {NEXT}") from error
