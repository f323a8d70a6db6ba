"""L_in and L_out of section 8."""

import torch

from viewmend.training.losses import image_loss, slivers


def loop_twin(predicted, coverage, error, truth):
    """Section 8, pixel by pixel."""
    parts = ([], [])
    for image, covered, E, target in zip(predicted, coverage, error, truth, strict=True):
        sums = [[0.0, 0.0], [0.0, 0.0]]
        for v in range(E.shape[0]):
            for u in range(E.shape[1]):
                away = sum(abs(float(image[c, v, u] - target[c, v, u])) for c in range(3)) / 3
                weights = (float(E[v, u]), (1 - float(E[v, u])) * (float(covered[v, u]) > 0))
                for total, weight in zip(sums, weights, strict=True):
                    total[0] += weight * away
                    total[1] += weight
        for part, (away, weight) in zip(parts, sums, strict=True):
            part.append(away / weight if weight else 0.0)
    return [sum(part) / len(part) for part in parts]


def test_losses_equal_the_loop(rng):
    sizes = [(5, 7), (6, 4)]
    predicted, truth = ([torch.rand(3, *s, generator=rng) for s in sizes] for _ in range(2))
    coverage = [(torch.rand(s, generator=rng) > 0.4).float() for s in sizes]
    error = [torch.rand(s, generator=rng) * (torch.rand(s, generator=rng) > 0.5) for s in sizes]
    loss = image_loss(predicted, coverage, error, truth)
    expected = loop_twin(predicted, coverage, error, truth)
    assert torch.allclose(torch.stack([loss.inside, loss.outside]), torch.tensor(expected), atol=1e-6)
    assert torch.allclose(loss.inside + loss.outside, torch.tensor(sum(expected)), atol=1e-6)


def test_an_empty_hole_gives_zero_and_a_zero_gradient(rng):
    predicted = torch.rand(3, 4, 4, generator=rng).requires_grad_()
    none = torch.zeros(4, 4)
    loss = image_loss([predicted], [none], [none], [torch.zeros(3, 4, 4)])
    total = loss.inside + loss.outside + 0.5 * (loss.log_error - loss.log_error.detach())
    total.backward()
    assert float(total.detach()) == 0
    assert predicted.grad is not None and not predicted.grad.any()


def test_the_logarithmic_error_is_a_tenth_of_psnr_in_the_holes(rng):
    predicted, truth = torch.rand(3, 6, 6, generator=rng), torch.rand(3, 6, 6, generator=rng)
    E = (torch.rand(6, 6, generator=rng) > 0.5).float()
    loss = image_loss([predicted], [E], [E], [truth])
    psnr = -10 * (predicted - truth)[:, E > 0].square().mean().log10()
    assert torch.allclose(-10 * loss.log_error, psnr, atol=0.02)


def sliver_twin(error):
    """Every square of nine pixels that the image holds a part of, one after the other."""
    height, width = error.shape
    missing, wide = error > 0, torch.zeros(height, width, dtype=torch.bool)
    for v in range(height):
        for u in range(width):
            part = missing[max(0, v - 4) : v + 5, max(0, u - 4) : u + 5]
            if bool(part.all()):
                wide[max(0, v - 4) : v + 5, max(0, u - 4) : u + 5] = True
    return missing & ~wide


def test_slivers_are_what_no_square_fits_into(rng):
    error = torch.zeros(40, 50)
    error[5:14, 5:14] = 0.5  # a square fits exactly
    error[20:28, 5:40] = 1  # a row too low
    error[14:20, 9] = 1  # between both
    error[30:, 41:] = 1  # in a corner
    found = slivers(error)
    assert torch.equal(found, sliver_twin(error))
    assert not found[5:14, 5:14].any() and bool(found[20:28, 5:40].all()) and bool(found[14:20, 9].all())
    assert not found[30:, 41:].any()
    random = (torch.rand(60, 60, generator=rng) > 0.03).float()
    assert torch.equal(slivers(random), sliver_twin(random)) and bool(slivers(random).any())
