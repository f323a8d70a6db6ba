"""The adversarial term: the formulas, who learns from it, and that views without holes teach nothing."""

import pytest
import torch
from reference.adversarial_twin import average, discriminator_twin, generator_twin

from viewmend.inpainting.decoder import blend
from viewmend.training.adversarial import (
    discriminator_loss,
    discriminator_objective,
    generator_loss,
    inpainter_objective,
)
from viewmend.training.discriminator import Discriminator, DiscriminatorConfig

OBJECTIVES = ("gan", "hinge")
KINDS = ("image", "clip")
SIZES = {"image": ((3, 12, 12), (3, 9, 20)), "clip": ((3, 2, 12, 12), (3, 3, 9, 20))}


def tiny(kind):
    torch.manual_seed(0)
    return Discriminator(DiscriminatorConfig(kind=kind, width=4, layers=2))


def maps(rng):
    return [3 * torch.randn(shape, generator=rng) for shape in ((2, 3, 4), (2, 5, 1))]


def pictures(kind, rng, low=0.0, high=1.0):
    return [low + (high - low) * torch.rand(size, generator=rng) for size in SIZES[kind]]


def holes(pictures, *there):
    return [torch.full(p.shape[1:], float(t)) for p, t in zip(pictures, there, strict=True)]


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_losses_equal_the_formulas(objective, rng):
    real, fake = maps(rng), maps(rng)
    numbers = [(r.flatten().tolist(), f.flatten().tolist()) for r, f in zip(real, fake, strict=True)]
    judge = discriminator_loss(real, fake, objective)
    assert float(judge) == pytest.approx(average([discriminator_twin(r, f, objective) for r, f in numbers]), rel=1e-5)
    inpainter = generator_loss(fake, objective)
    assert float(inpainter) == pytest.approx(average([generator_twin(f, objective) for _, f in numbers]), rel=1e-5)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_gradients_equal_differences_of_the_formulas(objective, rng):
    (real, _), (fake, _) = maps(rng), maps(rng)
    for twin, loss, logits in (
        (
            lambda x: discriminator_twin(x, [0.3], objective),
            lambda x: discriminator_loss([x], [torch.tensor([0.3])], objective),
            real,
        ),
        (
            lambda x: discriminator_twin([0.3], x, objective),
            lambda x: discriminator_loss([torch.tensor([0.3])], [x], objective),
            fake,
        ),
        (lambda x: generator_twin(x, objective), lambda x: generator_loss([x], objective), fake),
    ):
        logits = logits.flatten().clone().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(logits), logits)
        for place in range(len(logits)):
            more, less = logits.tolist(), logits.tolist()
            more[place] += 1e-4
            less[place] -= 1e-4
            assert float(gradient[place]) == pytest.approx((twin(more) - twin(less)) / 2e-4, abs=1e-5)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_a_sure_discriminator_gives_finite_numbers(objective):
    for value in (-1e4, 1e4):
        logits = torch.full((1, 2, 2), value, requires_grad=True)
        total = discriminator_loss([logits], [logits], objective) + generator_loss([logits], objective)
        total.backward()
        assert torch.isfinite(total) and logits.grad is not None and torch.isfinite(logits.grad).all()


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("kind", KINDS)
def test_it_learns_to_tell_bright_from_dark_and_says_so_to_the_inpainter(kind, objective, rng):
    net = tiny(kind)
    optimizer = torch.optim.Adam(net.parameters(), lr=3e-3, betas=(0.0, 0.99))
    losses = []
    for _ in range(40):
        bright, dark = pictures(kind, rng, 0.5, 1.0), pictures(kind, rng, 0.0, 0.5)
        loss = discriminator_objective(net, bright, dark, holes(dark, 1, 1), objective)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0]
    net.eval()
    bright, dark = pictures(kind, rng, 0.5, 1.0), pictures(kind, rng, 0.0, 0.5)
    with torch.no_grad():
        assert min(float(m.mean()) for m in net(bright)) > max(float(m.mean()) for m in net(dark))
    dark[0].requires_grad_()
    (gradient,) = torch.autograd.grad(inpainter_objective(net, dark, holes(dark, 1, 1), objective), dark[0])
    assert float(gradient.sum()) < 0, "going down makes the dark image brighter"


@pytest.mark.parametrize("kind", KINDS)
def test_each_side_learns_from_its_own_objective_alone(kind, rng):
    net, truth, completed = tiny(kind), pictures(kind, rng), pictures(kind, rng)
    for image in completed:
        image.requires_grad_()
    inpainter_objective(net, completed, holes(completed, 1, 1)).backward()
    assert all(p.grad is None for p in net.parameters())
    assert all(image.grad is not None and image.grad.any() for image in completed)
    for image in completed:
        image.grad = None
    discriminator_objective(net, truth, completed, holes(completed, 1, 1)).backward()
    assert all(p.grad is not None and p.grad.any() for p in net.parameters())
    assert all(image.grad is None for image in completed)


@pytest.mark.parametrize("objective", OBJECTIVES)
def test_a_view_without_a_hole_gives_zero_and_a_zero_gradient(objective, rng):
    net, truth, completed = tiny("image"), pictures("image", rng), pictures("image", rng)
    for image in completed:
        image.requires_grad_()
    inpainter = inpainter_objective(net, completed, holes(completed, 0, 1), objective)
    inpainter.backward()
    assert completed[0].grad is not None and not completed[0].grad.any()
    assert completed[1].grad is not None and completed[1].grad.any()
    alone = inpainter_objective(net.eval(), completed[1:], holes(completed[1:], 1), objective)
    both = inpainter_objective(net, completed, holes(completed, 0, 1), objective)
    assert float(both.detach()) == pytest.approx(float(alone.detach()) / 2), "it counts 0 in the mean, as in L_in"
    none = discriminator_objective(net, truth, completed, holes(completed, 0, 0), objective)
    none.backward()
    assert float(none.detach()) == 0
    assert all(p.grad is not None and not p.grad.any() for p in net.parameters())


def test_through_the_blend_only_holes_get_a_gradient(rng):
    known, inpainted = pictures("image", rng)[0], pictures("image", rng)[0].requires_grad_()
    E = torch.zeros(12, 12)
    E[3:6, 4:9], E[3:6, 4] = 1, 0.5
    completed = blend(known, E, inpainted, torch.ones_like(E))
    inpainter_objective(tiny("image"), [completed], [E]).backward()
    assert inpainted.grad is not None
    assert torch.equal(inpainted.grad.abs().sum(0) > 0, E > 0)


def test_halves_of_a_batch_average_to_the_batch(rng):
    net, truth, completed = tiny("image").eval(), pictures("image", rng), pictures("image", rng)
    error = holes(completed, 0, 1)
    whole = discriminator_objective(net, truth, completed, error)
    halves = [discriminator_objective(net, truth[i : i + 1], completed[i : i + 1], error[i : i + 1]) for i in (0, 1)]
    torch.testing.assert_close(whole, torch.stack(halves).mean())
