"""The adversarial loss and its discriminators equal their formulas, and train the right network."""

import pytest
import torch
from torch.nn.functional import binary_cross_entropy_with_logits

from viewmend.training.adversarial import (
    GAN,
    HINGE,
    Discriminator,
    Judged,
    discriminator_objective,
    inpainter_objective,
)

LOSSES = {"gan": GAN, "hinge": HINGE}
KINDS = ("image", "clip")
SIZES = {"image": ((3, 12, 12), (3, 9, 20)), "clip": ((3, 2, 12, 12), (3, 3, 9, 20))}
LARGER = {"image": ((3, 21, 18), (3, 16, 30)), "clip": ((3, 3, 21, 18), (3, 2, 16, 30))}


def tiny(kind, layers=2):
    torch.manual_seed(0)
    return Discriminator(kind, 4, layers)


def random_logits(rng):
    return [3 * torch.randn(shape, generator=rng) for shape in ((2, 3, 4), (2, 5, 1))]


def random_images(kind, rng, low=0.0, high=1.0, sizes=SIZES):
    return [low + (high - low) * torch.rand(size, generator=rng) for size in sizes[kind]]


def judged(truth, completed, *error):
    return Judged(
        truth, completed, [torch.full(p.shape[1:], float(t)) for p, t in zip(completed, error, strict=True)]
    )


def entropy(logits, target):
    return binary_cross_entropy_with_logits(logits, torch.full_like(logits, target))


FORMULAS = {
    "gan": (lambda real, fake: entropy(real, 1.0) + entropy(fake, 0.0), lambda fake: -entropy(fake, 0.0)),
    "hinge": (
        lambda real, fake: (1 - real).relu().mean() + (1 + fake).relu().mean(),
        lambda fake: -fake.mean(),
    ),
}
"""Of the discriminator and of the inpainter, from the logits of one image."""


class Fixed(Discriminator):
    """A discriminator that returns given logits."""

    def __init__(self, logits):
        super().__init__(width=1, layers=1)
        self.logits = logits

    def forward(self, images):
        return self.logits[-len(images) :]


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_equal_the_formulas(loss, rng):
    real, fake = random_logits(rng), random_logits(rng)
    batch = judged(random_images("image", rng), random_images("image", rng), 1, 1)
    of_discriminator, of_inpainter = FORMULAS[loss]
    expected = torch.stack([of_discriminator(r, f) for r, f in zip(real, fake, strict=True)]).mean()
    torch.testing.assert_close(discriminator_objective(Fixed([*real, *fake]), batch, LOSSES[loss]), expected)
    expected = torch.stack([of_inpainter(f) for f in fake]).mean()
    torch.testing.assert_close(inpainter_objective(Fixed(fake), batch, LOSSES[loss]), expected)


@pytest.mark.parametrize("loss", LOSSES.values(), ids=list(LOSSES))
def test_extreme_logits_give_finite_losses(loss):
    for value in (-1e4, 1e4):
        logits = torch.full((1, 2, 2), value, requires_grad=True)
        total = (loss.real(logits) + loss.fake(logits) + loss.generator(logits)).mean()
        total.backward()
        assert torch.isfinite(total) and logits.grad is not None and torch.isfinite(logits.grad).all()


@pytest.mark.parametrize("loss", LOSSES.values(), ids=list(LOSSES))
@pytest.mark.parametrize("kind", KINDS)
def test_the_discriminator_learns_and_its_gradient_guides_the_inpainter(kind, loss, rng):
    net = tiny(kind)
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3, betas=(0.0, 0.99))
    losses = []
    for _ in range(40):
        bright, dark = random_images(kind, rng, 0.5, 1.0), random_images(kind, rng, 0.0, 0.5)
        value = discriminator_objective(net, judged(bright, dark, 1, 1), loss)
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        losses.append(float(value.detach()))
    assert losses[-1] < 0.6 * losses[0]
    net.eval()
    bright, dark = random_images(kind, rng, 0.5, 1.0), random_images(kind, rng, 0.0, 0.5)
    with torch.no_grad():
        assert min(float(m.mean()) for m in net(bright)) > max(float(m.mean()) for m in net(dark))
    dark[0].requires_grad_()
    (gradient,) = torch.autograd.grad(inpainter_objective(net, judged(bright, dark, 1, 1), loss), dark[0])
    assert float(gradient.sum()) < 0, "descending makes the dark image brighter"


@pytest.mark.parametrize("kind", KINDS)
def test_each_network_gets_gradients_from_its_own_loss_only(kind, rng):
    net, truth, completed = tiny(kind), random_images(kind, rng), random_images(kind, rng)
    for image in completed:
        image.requires_grad_()
    batch = judged(truth, completed, 1, 1)
    inpainter_objective(net, batch).backward()
    assert all(p.grad is None for p in net.parameters())
    assert all(image.grad is not None and image.grad.any() for image in completed)
    for image in completed:
        image.grad = None
    discriminator_objective(net, batch).backward()
    assert all(p.grad is not None and p.grad.any() for p in net.parameters())
    assert all(image.grad is None for image in completed)


@pytest.mark.parametrize("loss", LOSSES.values(), ids=list(LOSSES))
def test_a_view_without_a_hole_contributes_zero(loss, rng):
    net, truth, completed = tiny("image"), random_images("image", rng), random_images("image", rng)
    for image in completed:
        image.requires_grad_()
    both = inpainter_objective(net, judged(truth, completed, 0, 1), loss)
    both.backward()
    assert completed[0].grad is not None and not completed[0].grad.any()
    assert completed[1].grad is not None and completed[1].grad.any()
    alone = inpainter_objective(net.eval(), judged(truth[1:], completed[1:], 1), loss)
    both = inpainter_objective(net, judged(truth, completed, 0, 1), loss)
    assert float(both.detach()) == pytest.approx(float(alone.detach()) / 2), (
        "it counts as 0 in the mean, as in L_in"
    )
    none = discriminator_objective(net, judged(truth, completed, 0, 0), loss)
    none.backward()
    assert float(none.detach()) == 0
    assert all(p.grad is not None and not p.grad.any() for p in net.parameters())


def test_t_patchgan_is_the_published_network():
    net = Discriminator("clip", 32, 6)
    assert sum(p.numel() for p in net.parameters()) == 4_461_728
    with torch.no_grad():
        (logits,) = net(list(torch.rand(1, 3, 1, 240, 432)))
    assert logits.shape == (128, 1, 4, 7)


def test_norms_stay_exact_under_autocast(rng):
    net, exact, images = tiny("image", 3), tiny("image", 3), random_images("image", rng, sizes=LARGER)
    with torch.autocast("cpu", torch.bfloat16):
        logits = net(images)
    torch.testing.assert_close(logits[0].float(), exact(images)[0], atol=0.02, rtol=0.05)
    for (name, own), other in zip(net.named_buffers(), exact.buffers(), strict=True):
        assert torch.equal(own, other), f"{name} was iterated in bfloat16"


def test_too_small_images_are_refused():
    with pytest.raises(ValueError, match="at least 3 x 3 pixels, got shapes"):
        tiny("clip")([torch.rand(3, 2, 2, 9)])
    (smallest,) = tiny("image")([torch.rand(3, 3, 3)])
    assert smallest.shape[1:] == (1, 1)


@pytest.mark.gpu
@pytest.mark.parametrize("kind", KINDS)
def test_cuda_equals_the_cpu(kind, rng):
    net, images = tiny(kind, 3).eval(), random_images(kind, rng, sizes=LARGER)
    here = net(images)
    there = net.cuda()([image.cuda() for image in images])
    for own, other in zip(here, there, strict=True):
        torch.testing.assert_close(other.cpu(), own, atol=1e-3, rtol=1e-2)  # TF32 convolutions
