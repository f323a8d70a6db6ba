"""The perceptual term: its twin, its crop, and that no other network takes VGG16's place.

The weights here are random numbers in a file with VGG16's keys: what it computes does not depend on what it learned.
"""

import pickle

import pytest
import torch
from reference.perceptual_twin import features_twin, perceptual_twin
from safetensors.torch import save_file

from viewmend.training.perceptual_loss import (
    CELL_PX,
    MARGIN_PX,
    PerceptualWeightsError,
    load_vgg16,
    perceptual_loss,
)

CHANNELS = {
    0: (3, 64), 2: (64, 64), 5: (64, 128), 7: (128, 128), 10: (128, 256), 12: (256, 256), 14: (256, 256),
    17: (256, 512), 19: (512, 512), 21: (512, 512), 24: (512, 512), 26: (512, 512), 28: (512, 512),
}  # fmt: skip
CLASSIFIER = {0: (25088, 4096), 3: (4096, 4096), 6: (4096, 1000)}


def empty_weights(classifier: bool = True) -> dict[str, torch.Tensor]:
    """All of torchvision's keys and shapes, of a single zero each: a small file."""
    zero, weights = torch.zeros(()), {}
    for place, (before, after) in CHANNELS.items():
        weights[f"features.{place}.weight"] = zero.expand(after, before, 3, 3)
        weights[f"features.{place}.bias"] = zero.expand(after)
    for place, (before, after) in CLASSIFIER.items() if classifier else ():
        weights[f"classifier.{place}.weight"] = zero.expand(after, before)
        weights[f"classifier.{place}.bias"] = zero.expand(after)
    return weights


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(7)
    filled = {}
    for key, empty in empty_weights(classifier=False).items():
        # What lies behind relu4_3 is never looked at.
        if int(key.split(".")[1]) > 21:
            filled[key] = empty
        elif key.endswith("weight"):
            filled[key] = (torch.randn(empty.shape, generator=rng) * (2 / empty[0].numel()) ** 0.5).half().float()
        else:
            filled[key] = (0.1 * torch.randn(empty.shape, generator=rng)).half().float()
    return filled


@pytest.fixture(scope="module")
def network(weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("vgg16") / "weights.pth"
    torch.save(weights, path)
    return load_vgg16(path)


def scene(rng):
    """Predicted, E and truth with a soft hole near a corner, so that the crop leaves the image."""
    predicted, truth = torch.rand(3, 30, 26, generator=rng), torch.rand(3, 30, 26, generator=rng)
    E = torch.zeros(30, 26)
    E[2:9, 15:24], E[2:9, 15] = 1, 0.4
    return predicted, E, truth


def test_features_equal_the_layers_written_out(network, weights, rng):
    image = torch.rand(3, 16, 24, generator=rng)
    ours, twins = network(image), features_twin(image, weights)
    assert [tuple(f.shape) for f in ours] == [(64, 16, 24), (128, 8, 12), (256, 4, 6), (512, 2, 3)]
    for own, twin in zip(ours, twins, strict=True):
        assert twin.max() > 0.1
        torch.testing.assert_close(own.double(), twin, atol=1e-4, rtol=1e-4)


def test_value_and_gradient_equal_the_twin(network, weights, rng):
    predicted, E, truth = scene(rng)
    predicted.requires_grad_()
    ours = perceptual_loss(network, [predicted], [E], [truth])
    twin = perceptual_twin(predicted, E, truth, weights, MARGIN_PX, CELL_PX)
    assert float(twin.detach()) > 0.01
    torch.testing.assert_close(ours.double(), twin, atol=1e-5, rtol=1e-4)
    (own,), (other,) = torch.autograd.grad(ours, predicted), torch.autograd.grad(twin, predicted)
    assert other.any() and not other[:, E == 0].any()
    torch.testing.assert_close(own, other, atol=1e-3 * float(other.abs().max()), rtol=1e-2)


def test_only_what_fills_a_hole_counts(network, rng):
    predicted, E, truth = scene(rng)
    right = torch.where(E > 0, truth, predicted)
    assert float(perceptual_loss(network, [right], [E], [truth])) == pytest.approx(0, abs=1e-6)
    elsewhere = torch.where(E > 0, predicted, torch.rand(predicted.shape, generator=rng))
    both = [perceptual_loss(network, [p], [E], [truth]) for p in (predicted, elsewhere)]
    assert torch.equal(*both)


def test_only_a_crop_around_the_hole_is_looked_at(network, rng):
    predicted, E, truth = (torch.nn.functional.pad(x, (200, 300, 100, 400)) for x in scene(rng))
    shown = []
    network.features[0].register_forward_pre_hook(lambda _, x: shown.append(tuple(x[0].shape)))
    loss = perceptual_loss(network, [predicted], [E], [truth])
    network.features[0]._forward_pre_hooks.clear()
    assert shown == [(3, 72, 80)] * 2
    small = perceptual_loss(network, *([x] for x in scene(torch.Generator().manual_seed(0))))
    torch.testing.assert_close(loss, small)


def test_an_empty_hole_gives_zero_and_a_zero_gradient(network, rng):
    predicted, E, truth = scene(rng)
    predicted.requires_grad_()
    loss = perceptual_loss(network, [predicted], [torch.zeros_like(E)], [truth])
    loss.backward()
    assert float(loss.detach()) == 0 and predicted.grad is not None and not predicted.grad.any()
    with torch.no_grad():
        half = perceptual_loss(network, [predicted] * 2, [torch.zeros_like(E), E], [truth] * 2)
        assert float(half) == pytest.approx(float(perceptual_loss(network, [predicted], [E], [truth])) / 2)


def test_the_network_is_frozen(network):
    assert not any(p.requires_grad for p in network.parameters()) and not network.training


def test_both_formats_and_halves_load_alike(network, weights, tmp_path):
    path = tmp_path / "vgg16.safetensors"
    save_file({key: weight.half().contiguous() for key, weight in weights.items()}, path)
    loaded = load_vgg16(path).state_dict()
    assert list(loaded) == [key for key in weights if int(key.split(".")[1]) <= 21]
    assert all(torch.equal(weight, weights[key]) for key, weight in loaded.items())
    assert all(torch.equal(weight, weights[key]) for key, weight in network.state_dict().items())


def test_a_whole_file_loads_and_is_found_where_torchvision_puts_it(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    place = tmp_path / "checkpoints" / "vgg16-397923af.pth"
    with pytest.raises(PerceptualWeightsError) as missing:
        load_vgg16()
    assert str(place) in str(missing.value)
    place.parent.mkdir()
    torch.save(empty_weights(), place)
    assert not any(weight.any() for weight in load_vgg16().state_dict().values())


def changed(**changes) -> dict[str, torch.Tensor]:
    named = {key.replace("__", "."): weight for key, weight in changes.items()}
    return {key: weight for key, weight in (empty_weights() | named).items() if weight is not None}


OTHERS = {
    "with batch norm": (changed(features__1__running_mean=torch.zeros(64)), "features.1.running_mean is none of its"),
    "vgg19": (changed(features__16__weight=torch.zeros(())), "features.16.weight is none of its"),
    "cut short": (changed(features__28__weight=None), "features.28.weight is missing"),
    "another width": (changed(features__0__weight=torch.zeros(32, 3, 3, 3)), r"\(32, 3, 3, 3\), not \(64, 3, 3, 3\)"),
    "another head": (changed(classifier__6__weight=torch.zeros(10, 4096)), r"\(10, 4096\), not \(1000, 4096\)"),
    "nothing": ({}, "features.0.weight is missing; .* and 23 more"),
    "nested": ({"state_dict": empty_weights()}, "expected a dictionary of tensors"),
    "a list": ([torch.zeros(3)], "expected a dictionary of tensors.*got list"),
}


@pytest.mark.parametrize("other", OTHERS)
def test_a_file_of_another_network_is_refused(other, tmp_path):
    content, message = OTHERS[other]
    path = tmp_path / "other.pth"
    torch.save(content, path)
    with pytest.raises(PerceptualWeightsError, match=message) as refused:
        load_vgg16(path)
    assert str(path) in str(refused.value) and "torchvision.models.vgg16" in str(refused.value)


class Payload:
    """A pickle that runs something when it is read."""

    def __reduce__(self):
        return (pytest.fail, ("the file was executed",))


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("content", ["empty", "noise", "half", "pickle"])
def test_a_damaged_file_is_refused_and_no_code_in_it_runs(content, suffix, tmp_path):
    whole = tmp_path / f"whole{suffix}"
    (torch.save if suffix == ".pth" else save_file)({"features.0.bias": torch.rand(999)}, whole)
    data = {
        "empty": b"",
        "noise": bytes(range(256)) * 8,
        "half": whole.read_bytes()[:1500],
        "pickle": pickle.dumps(Payload(), protocol=2),
    }[content]
    path = tmp_path / f"damaged{suffix}"
    path.write_bytes(data)
    with pytest.raises(PerceptualWeightsError, match=f"got {len(data)} bytes that do not read"):
        load_vgg16(path)


def test_a_missing_file_says_where_it_was_looked_for_and_what_to_do(tmp_path):
    with pytest.raises(
        PerceptualWeightsError, match=r"torchvision's vgg16 at .*nowhere.pth, got no such file; .*IMAGENET"
    ):
        load_vgg16(tmp_path / "nowhere.pth")
