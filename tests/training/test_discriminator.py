"""Patch discriminators: their twin, their norm, and that nothing mixes the images of a batch."""

import pytest
import torch
from reference.discriminator_twin import judge_twin

from viewmend.training.discriminator import Discriminator, DiscriminatorConfig

KINDS = ("image", "clip")
SHAPES = {"image": ((3, 21, 18), (3, 16, 30)), "clip": ((3, 3, 21, 18), (3, 2, 16, 30))}


def tiny(kind, **options):
    torch.manual_seed(0)
    return Discriminator(DiscriminatorConfig(kind=kind, **({"width": 4, "layers": 3} | options)))


def some(kind, rng):
    return [torch.rand(shape, generator=rng) for shape in SHAPES[kind]]


def learned(net):
    return [p for n, p in net.named_parameters() if "weight" in n]


def largest(weight):
    return float(torch.linalg.svdvals(weight.detach().flatten(1))[0])


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_gradients_equal_the_twin_once_power_iteration_has_converged(kind, rng):
    net, images = tiny(kind), some(kind, rng)
    for _ in range(300):
        net([images[0]])
    net.eval()
    images[0].requires_grad_()
    weights = learned(net)
    bias = net.convolutions[-1].bias
    first_padding = 2 if kind == "image" else 1
    for image, logits in zip(images, net(images), strict=True):
        twin = judge_twin(image, weights, bias, first_padding)
        torch.testing.assert_close(logits.double(), twin, atol=1e-5, rtol=1e-4)
    sources = [images[0], *weights]
    ours = torch.autograd.grad(net(images)[0].square().sum(), sources)
    twins = torch.autograd.grad(judge_twin(images[0], weights, bias, first_padding).square().sum(), sources)
    for own, twin in zip(ours, twins, strict=True):
        assert twin.abs().max() > 0
        torch.testing.assert_close(own, twin.float(), atol=1e-4 * float(twin.abs().max()), rtol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_no_hidden_layer_amplifies_after_some_calls_and_the_last_may(kind, rng):
    net = tiny(kind)
    with torch.no_grad():
        for weight in learned(net):
            weight.mul_(7).add_(torch.randn(weight.shape, generator=rng))
    images = some(kind, rng)[:1]
    # Power iteration comes from below, and slowly where the largest singular values are close.
    for calls, slack in ((30, 0.05), (300, 0.002)):
        for _ in range(calls):
            net(images)
        *hidden, last = (largest(layer.weight) for layer in net.convolutions)
        assert all(1 - 1e-4 < norm < 1 + slack for norm in hidden), (calls, hidden)
    assert last > 2
    assert all(largest(weight) > 2 for weight in learned(net)), "what is learned keeps its size"


@pytest.mark.parametrize("kind", KINDS)
def test_an_image_is_judged_as_if_it_were_alone(kind, rng):
    net = tiny(kind).eval()
    first, second = some(kind, rng)
    third = torch.rand(first.shape, generator=rng)
    together = net([first, second, third])
    for logits, image in zip(together, (first, second, third), strict=True):
        torch.testing.assert_close(logits, net([image])[0], atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_a_call_takes_one_step_of_power_iteration_in_training_and_none_otherwise(kind, rng):
    net, images = tiny(kind), some(kind, rng)
    u = next(b for n, b in net.named_buffers() if n.endswith("_u"))
    states = []
    for training in (True, False):
        net.train(training)
        earlier = u.clone()
        net(images)
        states.append(torch.equal(u, earlier))
    assert states == [False, True]


def test_t_patchgan_is_the_published_network():
    net = Discriminator(DiscriminatorConfig(kind="clip", width=32, layers=6))
    assert sum(p.numel() for p in net.parameters()) == 4_461_728
    with torch.no_grad():
        (logits,) = net(list(torch.rand(1, 3, 1, 240, 432)))
    assert logits.shape == (128, 1, 4, 7)


def test_it_works_under_autocast_with_exact_norms(rng):
    net = tiny("image")
    exact = tiny("image")
    images = some("image", rng)
    with torch.autocast("cpu", torch.bfloat16):
        logits = net(images)
    torch.testing.assert_close(logits[0].float(), exact(images)[0], atol=0.02, rtol=0.05)
    for (name, own), other in zip(net.named_buffers(), exact.buffers(), strict=True):
        assert torch.equal(own, other), f"{name} was iterated in bfloat16"


def test_its_state_can_be_saved_and_goes_on(rng):
    net, images = tiny("clip"), some("clip", rng)
    net(images)
    torch.manual_seed(5)
    other = Discriminator(DiscriminatorConfig(kind="clip", width=4, layers=3))
    other.load_state_dict(net.state_dict())
    assert all(torch.equal(a, b) for a, b in zip(net(images), other(images), strict=True))


def test_what_cannot_be_judged_is_refused():
    with pytest.raises(ValueError, match="at least 3 x 3 pixels, got shapes"):
        tiny("clip")([torch.rand(3, 2, 2, 9)])
    with pytest.raises(ValueError, match="at least 2 layers, got 32 and 1"):
        DiscriminatorConfig(layers=1)
    (smallest,) = tiny("image")([torch.rand(3, 3, 3)])
    assert smallest.shape[1:] == (1, 1)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", KINDS)
def test_cuda_equals_the_cpu(kind, rng):
    net, images = tiny(kind).eval(), some(kind, rng)
    here = net(images)
    there = net.cuda()([image.cuda() for image in images])
    for own, other in zip(here, there, strict=True):
        torch.testing.assert_close(other.cpu(), own, atol=1e-3, rtol=1e-2)  # TF32 convolutions
