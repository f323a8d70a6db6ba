"""Compares baselines with outputs of the published networks, for reproducible weights and inputs."""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.contrib.baselines.dstt import DSTT
from viewmend.contrib.baselines.e2fgvi import E2FGVI, E2FGVIHQ
from viewmend.contrib.baselines.fuseformer import FuseFormer
from viewmend.contrib.baselines.token_transformer import NATIVE_PX, MemorySlot, TokenTransformer
from viewmend.utils.untrusted_input import InputError

TOLERANCE = 1e-3
"""Largest absolute difference, for outputs in [-1, 1], of two equal float32 networks."""
STRIDE_PX = 6
"""Files keep every sixth row and column of the output."""
OWN_VALUES = ("valid_ind_rolled", "update_spynet.mean", "update_spynet.std")
"""Entries of a state dict that keep their values: constants, not weights."""
FIELDS = ("name", "frames", "seed", "output", "mean", "std")
"""Fields of every file; files of E2FGVI also have `n_local`."""


class ParityFileError(InputError):
    """A file that is not a parity file: what was expected, what was found, the next step."""


@dataclass(frozen=True)
class ParityCase:
    """One file: the published network's name, inputs and outputs."""

    name: str
    frames: int
    seed: int
    n_local: int
    """E2FGVI: the first n_local frames are consecutive, the others references; else 0."""
    output: Float[Tensor, "frame 3 rows cols"]
    """Every sixth row and column of each output frame."""
    mean: Float[Tensor, " frame"]
    std: Float[Tensor, " frame"]
    """Mean and standard deviation of each whole output frame."""


@dataclass(frozen=True)
class ParityResult:
    """Differences of our network from one file."""

    name: str
    frames: int
    seed: int
    difference: float
    """Largest absolute difference of an output value."""
    mean_difference: float
    std_difference: float
    """The same of the frames' means and standard deviations."""

    @property
    def passed(self) -> bool:
        """Whether all agree to the tolerance; NaN does not."""
        return all(d <= TOLERANCE for d in (self.difference, self.mean_difference, self.std_difference))


def check(path: str | Path, device: torch.device | str = "cpu") -> ParityResult:
    """Generate the file's weights and inputs, run our network, and compare.

    Raises:
        ParityFileError: the file is missing, damaged, of another format, or of an unknown network.
    """
    case = read_case(path)
    output = run(case.name, case.frames, case.seed, case.n_local, device).cpu()
    mean, std = output.double().mean((1, 2, 3)), output.double().std((1, 2, 3), correction=0)
    sampled = output[..., ::STRIDE_PX, ::STRIDE_PX]
    return ParityResult(
        case.name,
        case.frames,
        case.seed,
        _largest(sampled - case.output),
        _largest(mean - case.mean),
        _largest(std - case.std),
    )


def read_case(path: str | Path) -> ParityCase:
    """The file's contents; ParityFileError if it is not a parity file."""
    path = Path(path)
    if not path.is_file():
        raise ParityFileError(f"{path}: expected a parity file (.npz), found none; check the path")
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            values = {field: file[field] for field in (*FIELDS, "n_local") if field in file}
    except Exception as error:  # damaged files raise almost anything
        said = "pickled objects, or no .npz at all" if "allow_pickle" in str(error) else str(error)
        raise ParityFileError(f"{path}: expected a whole .npz file, got one that does not read ({said})") from error
    if absent := [field for field in FIELDS if field not in values]:
        raise ParityFileError(f"{path}: expected the fields {list(FIELDS)}, {absent} missing; see the format")
    try:
        return _case(values)
    except (ValueError, TypeError, OverflowError) as error:
        raise ParityFileError(f"{path}: {error}; regenerate the file") from error


def _case(values: dict[str, np.ndarray]) -> ParityCase:
    """ValueError or TypeError for an invalid field."""
    numbers = [values.get(field, np.array(0)).item() for field in ("frames", "seed", "n_local")]
    if any(number != int(number) for number in numbers):
        raise ValueError(f"expected whole numbers of frames, seed and n_local, got {numbers}")
    frames, seed, n_local = map(int, numbers)
    name = values["name"].item()
    name = name.decode() if isinstance(name, bytes) else str(name)
    if name not in NETWORKS:
        raise ValueError(f"expected a network among {sorted(NETWORKS)}, got {name!r}")
    if frames < 1 or not 0 <= seed < 2**32:
        raise ValueError(f"expected 1 or more frames and a seed of 0 to {2**32 - 1}, got {frames} and {seed}")
    if NETWORKS[name][1] is _with_references and not 1 <= n_local <= frames:
        raise ValueError(f"expected an n_local of 1 to the {frames} frames, got {n_local}")
    output, mean, std = (torch.from_numpy(values[field].astype(np.float32)) for field in ("output", "mean", "std"))
    expected = (frames, 3, *(-(-side // STRIDE_PX) for side in NATIVE_PX))
    if output.shape != expected or mean.shape != (frames,) or std.shape != (frames,):
        raise ValueError(
            f"expected an output of {expected}, and a mean and a standard deviation of each frame, got "
            f"{tuple(output.shape)}, {tuple(mean.shape)}, {tuple(std.shape)}"
        )
    return ParityCase(name, frames, seed, n_local, output, mean, std)


@torch.inference_mode()
def run(
    name: str, frames: int, seed: int, n_local: int = 0, device: torch.device | str = "cpu"
) -> Float[Tensor, "frame 3 height width"]:
    """The output of our network of this name for the recipe's weights and input."""
    make, compute = NETWORKS[name]
    network = make()
    network.load_state_dict(recipe_weights(network, seed))
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):  # float32 means float32
        return compute(network.to(device).eval(), recipe_input(frames, seed).to(device), n_local)


def recipe_weights(network: nn.Module, seed: int) -> dict[str, Tensor]:
    """Random weights that depend only on each key, its shape and the seed."""
    weights = {}
    for key, value in network.state_dict().items():
        if not value.is_floating_point() or key.endswith(OWN_VALUES):
            weights[key] = value
            continue
        shape = tuple(value.shape)
        generator = np.random.RandomState((zlib.crc32(key.encode()) + seed) % 2**32)
        drawn = generator.standard_normal(shape).astype(np.float32)
        if key.endswith(("pos_emb", "sc.bias")):
            drawn = 0.1 * drawn
        elif len(shape) >= 2:
            drawn = drawn / np.float32(math.sqrt(math.prod(shape[1:])))
        elif key.endswith("bias"):
            drawn = 0.1 * drawn
        else:
            drawn = 1 + 0.1 * drawn
        weights[key] = torch.from_numpy(drawn.astype(np.float32))
    return weights


def recipe_input(frames: int, seed: int) -> Float[Tensor, "frame 3 240 432"]:
    """Coarse and fine noise in [-1, 1], with a moving hole of zeros."""
    height, width = NATIVE_PX
    generator = np.random.RandomState(seed)
    coarse = generator.uniform(-1, 1, (1, frames, 3, height // 8, width // 8)).astype(np.float32)
    fine = generator.standard_normal((1, frames, 3, height, width))
    images = np.clip(coarse.repeat(8, -2).repeat(8, -1) + 0.1 * fine, -1, 1)
    for time in range(frames):
        a = 7 * time % 40
        images[0, time, :, 80 + a : 140 + a, 150 + 2 * a : 230 + 2 * a] = 0
    return torch.from_numpy(images[0].astype(np.float32))


def _at_once(network: nn.Module, frames: Tensor, n_local: int) -> Tensor:
    return network(frames[None])[0]


def _with_references(network: nn.Module, frames: Tensor, n_local: int) -> Tensor:
    return network(frames[None], n_local)[0]


def _one_by_one(network: nn.Module, frames: Tensor, n_local: int) -> Tensor:
    assert isinstance(network, TokenTransformer)
    memory: list[MemorySlot] = []
    outputs = []
    for frame in frames:
        output, slot = network.complete_remembering(frame[None], memory)
        memory.append(slot)
        outputs.append(output)
    return torch.stack(outputs)


Compute = Callable[[nn.Module, Tensor, int], Tensor]
NETWORKS: dict[str, tuple[Callable[[], nn.Module], Compute]] = {
    "DSTT": (DSTT, _at_once),
    "DSTT_OM": (DSTT, _one_by_one),
    "FuseFormer": (FuseFormer, _at_once),
    "FuseFormer_OM": (FuseFormer, _one_by_one),
    "E2FGVI": (E2FGVI, _with_references),
    "E2FGVI_HQ": (E2FGVIHQ, _with_references),
}
"""How each network that a file may name is made and run.

E2FGVI with memory is not among them: how its authors' online variant samples flows is not fixed enough to compare.
"""


def _largest(difference: Tensor) -> float:
    return float(difference.abs().max())
