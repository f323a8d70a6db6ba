"""The baselines compute what the published networks compute, for weights and inputs that follow from a seed."""

import math
import zlib

import numpy as np
import pytest
import torch

from viewmend.contrib.baselines.e2fgvi import E2FGVI, E2FGVIHQ
from viewmend.contrib.baselines.token_transformers import DSTT, FuseFormer

FILES = ("dstt_t5", "dstt_om_4", "fuseformer_t5", "e2fgvi_t5_local3", "e2fgvi_hq_t5_local3")
"""Of `dstt_om_4`, a stream with memory, the first frame is the network alone, and quickly computed."""
NETWORKS = {"DSTT": DSTT, "FuseFormer": FuseFormer, "E2FGVI": E2FGVI, "E2FGVI_HQ": E2FGVIHQ}
CONSTANTS = ("valid_ind_rolled", "update_spynet.mean", "update_spynet.std")
"""Entries of a state dict that keep their values."""


def drawn_weights(network, seed):
    """Random weights that depend only on each key, its shape and the seed."""
    weights = {}
    for key, value in network.state_dict().items():
        if not value.is_floating_point() or key.endswith(CONSTANTS):
            weights[key] = value
            continue
        shape = tuple(value.shape)
        generator = np.random.RandomState((zlib.crc32(key.encode()) + seed) % 2**32)
        drawn = generator.standard_normal(shape).astype(np.float32)
        if key.endswith(("pos_emb", "sc.bias")):
            drawn = 0.1 * drawn
        elif len(shape) >= 2:
            drawn = drawn / np.float32(math.sqrt(math.prod(shape[1:])))
        else:
            drawn = 0.1 * drawn + (0 if key.endswith("bias") else 1)
        weights[key] = torch.from_numpy(drawn.astype(np.float32))
    return weights


def drawn_frames(frames, seed):
    """Coarse and fine noise in [-1, 1], with a moving hole of zeros."""
    generator = np.random.RandomState(seed)
    coarse = generator.uniform(-1, 1, (1, frames, 3, 30, 54)).astype(np.float32)
    fine = generator.standard_normal((1, frames, 3, 240, 432))
    images = np.clip(coarse.repeat(8, -2).repeat(8, -1) + 0.1 * fine, -1, 1)
    for time in range(frames):
        a = 7 * time % 40
        images[0, time, :, 80 + a : 140 + a, 150 + 2 * a : 230 + 2 * a] = 0
    return torch.from_numpy(images[0].astype(np.float32))


@pytest.mark.parametrize(
    "name", [n if n == "dstt_om_4" else pytest.param(n, marks=pytest.mark.slow) for n in FILES]
)
@torch.inference_mode()
def test_the_baselines_compute_what_the_published_networks_do(name, shared):
    case = np.load(shared / "parity" / f"{name}.npz")
    kind, frames, seed = (case[key].item() for key in ("name", "frames", "seed"))
    network = NETWORKS[kind.removesuffix("_OM")]().eval()
    network.load_state_dict(drawn_weights(network, seed))
    local, shown = case["n_local"].item() if "n_local" in case else 0, 1 if kind.endswith("_OM") else frames
    output = network(drawn_frames(frames, seed)[None, :shown], *[local] * (local > 0))[0].numpy()
    # Rounding is 1e-5 at most; an epsilon of a norm, or a border read differently, is 1e-3 and more.
    np.testing.assert_allclose(output[..., ::6, ::6], case["output"][:shown], rtol=0, atol=5e-5)
    np.testing.assert_allclose(output.mean((1, 2, 3)), case["mean"][:shown], rtol=0, atol=5e-5)
    np.testing.assert_allclose(output.std((1, 2, 3)), case["std"][:shown], rtol=0, atol=5e-5)
