"""LPIPS against a second implementation, with random weights."""

import pytest
import torch
from reference.lpips_twin import lpips_twin

from viewmend.metrics import weights as weights_module
from viewmend.metrics.lpips import Lpips, load_lpips
from viewmend.metrics.weights import KnownWeights
from viewmend.utils.weight_files import MissingWeightsError, WeightsError


def random_weights(network, rng):
    """Weights that do not saturate the features."""
    found = {}
    for key, value in network.state_dict().items():
        spread = (2 / value[0].numel()) ** 0.5 if value.dim() > 1 else 0.1
        found[key] = spread * torch.randn(value.shape, generator=rng)
        if key.startswith("lin"):
            found[key] = found[key].abs()
    return found


@pytest.fixture
def files(tmp_path, monkeypatch, rng):
    """Both files of each network in a searched folder, without known hashes."""
    monkeypatch.setenv("VIEWMEND_WEIGHTS", str(tmp_path))
    saved = {}
    for backbone, names in (("alex", ("alexnet", "lpips-alex")), ("vgg", ("vgg16", "lpips-vgg"))):
        metric = Lpips(backbone)
        saved[backbone] = [random_weights(part, rng) for part in (metric.network, metric.heads)]
        for name, tensors in zip(names, saved[backbone], strict=True):
            extra = {"classifier.1.weight": torch.zeros(2, 2)} if name == "alexnet" else {}
            torch.save(tensors | extra, tmp_path / f"{name}.pth")
    names = ("alexnet", "vgg16", "lpips-alex", "lpips-vgg")
    known = tuple(KnownWeights(name, (f"{name}.pth",), "w", "s", "l") for name in names)
    monkeypatch.setattr(weights_module, "KNOWN", known)
    return saved


@pytest.mark.parametrize(("backbone", "least"), [("alex", 63), ("vgg", 16)])
def test_it_matches_the_reference_and_its_map_adds_up(files, rng, backbone, least):
    truth, noise = torch.rand(2, 3, 70, 90, generator=rng)
    image = (0.7 * truth + 0.3 * noise).clamp(0, 1)
    metric = load_lpips(backbone)
    expected = lpips_twin(image, truth, *files[backbone], backbone)
    layers, seen = metric.layers(image, truth), metric(image, truth)
    assert expected > 0.01 and seen.shape == (70, 90)
    assert float(sum(x.double().mean() for x in layers)) == pytest.approx(expected, abs=1e-5)
    assert float(seen.mean()) == pytest.approx(expected, rel=0.01)
    assert not metric(truth, truth).any()
    assert metric(torch.zeros(3, least - 1, 99), torch.zeros(3, least - 1, 99)) is None
    assert metric(torch.zeros(3, least, 99), torch.zeros(3, least, 99)) is not None


def test_the_map_is_large_where_images_differ(files, rng):
    truth = torch.rand(3, 96, 96, generator=rng)
    image = truth.clone()
    image[:, 70:80, 70:80] = 1
    seen = load_lpips("vgg")(image, truth)
    assert seen[70:80, 70:80].mean() > 5 * seen.mean() > 0


def test_wrong_and_missing_weights_are_refused(files, tmp_path):
    torch.save(files["vgg"][0], tmp_path / "alexnet.pth")
    with pytest.raises(WeightsError, match=r"alexnet.pth: expected the 10 tensors of Features"):
        load_lpips("alex")
    (tmp_path / "lpips-vgg.pth").unlink()
    with pytest.raises(MissingWeightsError, match=r"lpips-vgg.pth .*in one of .*VIEWMEND_WEIGHTS"):
        load_lpips("vgg")
