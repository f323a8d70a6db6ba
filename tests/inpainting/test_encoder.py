"""The encoder against its twin, its size, and the crop that stands for the whole image."""

import torch
from inpainting.plates import TINY, context
from reference.encoder_twin import encode_twin

from viewmend.inpainting.config import paper
from viewmend.inpainting.encoder import RECEPTIVE_RADIUS_PX, Encoder
from viewmend.inpainting.images import Tokeniser, context_images
from viewmend.inpainting.patches import PATCH_CELLS, STEP_CELLS, padded_size, split


def test_the_encoder_equals_its_twin(rng):
    encoder = Encoder(TINY)
    for layer in encoder.layers:
        torch.nn.init.normal_(layer.bias, generator=rng)
    images = torch.rand(2, 6, 24, 36, generator=rng)
    slow = encode_twin([layer.weight for layer in encoder.layers], [layer.bias for layer in encoder.layers], images)
    assert torch.allclose(encoder(images), slow, atol=1e-4, rtol=1e-4)
    assert slow.shape == (2, 8, 6, 9)


def test_the_papers_encoder_has_the_sizes_of_the_table():
    encoder = Encoder(paper())
    shapes = [tuple(layer.weight.shape) for layer in encoder.layers]
    assert shapes == [
        (64, 5, 3, 3),
        (64, 64, 3, 3),
        (128, 64, 3, 3),
        (256, 128, 3, 3),
        (384, 256, 3, 3),
        (512, 320, 3, 3),
        (384, 192, 3, 3),
        (256, 80, 3, 3),
        (128, 512, 3, 3),
    ]
    extra_inputs = 2 * 64 * 9  # mask and depth
    assert sum(p.numel() for p in encoder.parameters()) == 4_206_400 + extra_inputs


def test_the_receptive_radius_is_what_is_written(rng):
    image = torch.rand(1, 6, 140, 140, generator=rng, requires_grad=True)
    Encoder(TINY)(image)[0, :, 17, 17].square().sum().backward()
    seen = torch.nonzero(image.grad[0].abs().sum(0))
    cell = torch.tensor([17 * 4, 17 * 4 + 3])
    reach = max(int(cell[0] - seen.min()), int(seen.max() - cell[1]))
    assert reach <= RECEPTIVE_RADIUS_PX
    assert reach >= RECEPTIVE_RADIUS_PX - 4


def test_encoding_a_crop_equals_encoding_everything():
    tokeniser = Tokeniser(TINY)
    for layer in tokeniser.encoder.layers:
        torch.nn.init.normal_(layer.bias, 0, 0.2)
    small = context_images(context(0, width=66, height=60), TINY)
    large = context_images(context(0, width=200, height=170), TINY)
    with torch.no_grad():
        tokens = tokeniser([small, large])
        whole = []
        for stack in (small, large):
            views, channels, height, width = stack.channels.shape
            full = padded_size(*stack.kept.shape[1:])
            canvas = torch.zeros(views, channels, full[0] + 160, full[1] + 160)
            canvas[:, :, 80 : 80 + height, 80 : 80 + width] = stack.channels
            maps = torch.cat([tokeniser.encoder(canvas), torch.nn.functional.avg_pool2d(canvas, 4)], 1)
            patches = split(maps[:, :, 20:, 20:], stack.places, PATCH_CELLS, STEP_CELLS)
            whole.append(tokeniser.norm(tokeniser.linear(patches.flatten(1))))
    assert torch.allclose(tokens, torch.cat(whole), atol=1e-4)
    assert not bool(large.kept.all()), "something must have been cropped away"


def test_background_patches_are_discarded_and_nothing_else():
    images = context_images(context(0, width=200, height=170), TINY)
    for view in range(2):
        for row in range(images.kept.shape[1]):
            for col in range(images.kept.shape[2]):
                patch = images.foreground[view, row * 16 : row * 16 + 28, col * 16 : col * 16 + 28]
                assert bool(images.kept[view, row, col]) == bool(patch.any())


def test_gradients_of_some_images_count_for_all(rng):
    tokeniser = Tokeniser(TINY)
    stacks = [context_images(context(t, width=66, height=60), TINY) for t in range(3)]
    towards = torch.randn(len(tokeniser(stacks)), TINY.dim, generator=rng)

    def gradients(share: float) -> list[torch.Tensor]:
        tokeniser.zero_grad()
        tokens = tokeniser(stacks, share)
        assert torch.equal(tokens, whole)
        (tokens * towards).sum().backward()
        parameters = (tokeniser.encoder.layers[2].weight, tokeniser.linear.weight)
        return [torch.zeros_like(p) if p.grad is None else p.grad.clone() for p in parameters]

    with torch.no_grad():
        whole = tokeniser(stacks, 0.5)
    encoder, linear = gradients(1.0)
    torch.manual_seed(0)
    some = [gradients(0.5) for _ in range(400)]
    assert all(torch.allclose(own, linear, atol=1e-5) for _, own in some), "only the encoding is learned from in part"
    drawn = torch.stack([own for own, _ in some])
    away = (drawn.mean(0) - encoder).norm() / encoder.norm()
    assert float(away) < 0.15 < float((drawn[0] - encoder).norm() / encoder.norm())
