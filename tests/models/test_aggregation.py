"""Ray samples are aggregated alike by the compiled loop and by PyTorch."""

import pytest
import torch

from viewmend.models.views.aggregation import SampleAggregator
from viewmend.models.views.config import FEATURES, IN_VIEW, STATISTICS
from viewmend.models.views.sampler import RaySamples


@pytest.fixture
def samples():
    """150 rays with 3 samples and 5 cameras, each of which sees two thirds of them; one sample is in no view."""
    torch.manual_seed(3)
    seen = (torch.rand(150, 3, 5) > 1 / 3).float()
    seen[7, 1] = 0
    features = torch.rand(150, 3, 5, FEATURES) * seen[..., None]
    features[..., IN_VIEW] = seen
    prior = torch.rand(150, 3, 5) * seen
    return RaySamples(features, prior / prior.sum(2, keepdim=True).clamp_min(1e-6), torch.rand(150, 3, STATISTICS))


@pytest.mark.parametrize("own_prior", [True, False])
def test_the_compiled_loop_equals_pytorch(samples, own_prior):
    torch.manual_seed(0)
    net, prior = SampleAggregator(24, 12), None if own_prior else torch.rand(150, 3, 5)
    before = [part.clone() for part in samples]
    with torch.no_grad():
        fast = net(samples, prior)
    assert all(torch.equal(part, old) for part, old in zip(samples, before, strict=True)), "inputs are not changed"
    slow = net(samples, prior)
    for name, own, wanted in zip(fast._fields, fast, slow, strict=True):
        torch.testing.assert_close(own, wanted.detach(), atol=1e-5, rtol=1e-5, msg=lambda m, name=name: f"{name}: {m}")
    seen = samples.features[..., IN_VIEW]
    assert not bool(fast.trust[seen == 0].any())
    torch.testing.assert_close(fast.trust.sum(2), seen.amax(2), atol=1e-5, rtol=0)
    mean = (fast.trust[..., None] * samples.features).sum(2)
    torch.testing.assert_close(torch.cat([fast.colour, fast.mask], -1), mean[..., :4])
