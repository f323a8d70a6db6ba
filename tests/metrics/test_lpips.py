"""LPIPS against a second implementation and published values; with AlexNet, it needs no other files."""

import numpy as np
import pytest
import torch
from reference.lpips_twin import lpips_twin

from viewmend.metrics import weights as weights_module
from viewmend.metrics.lpips import MIN_PX, Lpips, load_lpips
from viewmend.metrics.weights import KnownWeights
from viewmend.utils.weight_files import MissingWeightsError, WeightsError


@pytest.fixture
def random_vgg(tmp_path, monkeypatch, rng):
    """VGG16's file with random weights that do not saturate the features, without a known hash."""
    monkeypatch.setenv("VIEWMEND_WEIGHTS", str(tmp_path))
    saved = {}
    for key, value in Lpips("vgg").state_dict().items():
        spread = (2 / value[0].numel()) ** 0.5 if value.dim() > 1 else 0.1
        saved[key] = spread * torch.randn(value.shape, generator=rng)
        if key.startswith("heads"):
            saved[key] = saved[key].abs()
    torch.save(saved, tmp_path / "vgg.pth")
    monkeypatch.setattr(weights_module, "KNOWN", (KnownWeights("lpips-vgg", ("vgg.pth",), "w", "s", "l"),))
    return saved


def images(rng, size):
    truth, noise = torch.rand(2, 3, *size, generator=rng)
    return (0.7 * truth + 0.3 * noise).clamp(0, 1), truth


def agrees_with_the_twin(metric, image, truth):
    expected = lpips_twin(image, truth, metric.state_dict(), metric.backbone)
    seen = metric.map(image, truth)
    assert expected > 0.01 and seen.shape == image.shape[1:]
    assert float(metric(image[None], truth[None])) == pytest.approx(expected, abs=1e-5)
    assert float(seen.mean()) == pytest.approx(expected, abs=1e-5)
    repeated = seen[:, 1:] == seen[:, :-1]
    assert float(repeated.float().mean()) < 0.2, "layers are enlarged bilinearly"
    assert not metric.map(truth, truth).any()
    least = MIN_PX[metric.backbone]
    assert metric.map(torch.zeros(3, least - 1, 99), torch.zeros(3, least - 1, 99)) is None
    assert metric.map(torch.zeros(3, least, 99), torch.zeros(3, least, 99)) is not None
    smallest = torch.zeros(1, 3, least, 99)
    assert float(metric(smallest, smallest)) == 0
    with pytest.raises(ValueError, match=f"at least {least} pixels a side .* got 99 x {least - 1}"):
        metric(torch.zeros(1, 3, least - 1, 99), torch.zeros(1, 3, least - 1, 99))


def test_alexnet_ships_and_matches_the_reference(rng, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    agrees_with_the_twin(load_lpips("alex"), *images(rng, (70, 90)))


def test_vgg_matches_the_reference(random_vgg, rng):
    agrees_with_the_twin(load_lpips("vgg"), *images(rng, (40, 52)))


def test_published_values():
    rng = np.random.default_rng(0)
    a = rng.random((3, 96, 128)).astype(np.float32)
    b = np.clip(a + 0.2 * rng.standard_normal(a.shape), 0, 1).astype(np.float32)
    pair = torch.stack([torch.from_numpy(b), torch.full((3, 96, 128), 0.5)])
    expected = {"alex": (0.0644622, 1.3178893), "vgg": (0.1341660, 0.9134053)}
    for backbone, values in expected.items():
        try:
            metric = load_lpips(backbone)
        except MissingWeightsError:
            continue  # VGG16 is optional
        with torch.no_grad():
            assert metric(pair, torch.from_numpy(a).expand(2, -1, -1, -1)).tolist() == pytest.approx(
                values, abs=2e-6
            )


def test_it_is_a_training_loss(rng):
    metric = load_lpips("alex").train()
    image, truth = (x[None].clone() for x in images(rng, (64, 64)))
    image[..., :32] = 0  # features of 0 must not make the gradient NaN
    truth[..., :32] = 0
    image.requires_grad_()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss = metric(image, truth)
    assert loss.shape == (1,) and loss.dtype == torch.float32
    before = float(loss.detach())
    (gradient,) = torch.autograd.grad(loss.sum(), image)
    assert gradient.isfinite().all() and gradient.abs().max() > 0
    assert float(metric((image - 0.01 * gradient / gradient.abs().max()).detach(), truth)) < before
    assert not any(parameter.requires_grad for parameter in metric.parameters())


def test_wrong_and_missing_weights_are_refused(random_vgg, tmp_path):
    torch.save({"heads.0": torch.zeros(64)}, tmp_path / "vgg.pth")
    with pytest.raises(WeightsError, match=r"vgg.pth: expected the 31 tensors of Lpips"):
        load_lpips("vgg")
    (tmp_path / "vgg.pth").unlink()
    with pytest.raises(MissingWeightsError, match=r"vgg.pth .*in one of .*VIEWMEND_WEIGHTS"):
        load_lpips("vgg")
