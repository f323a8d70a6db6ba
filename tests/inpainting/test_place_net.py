"""Places along rays are weighed alike by the compiled loop and by torch, however many at once."""

import pytest
import torch

from viewmend.inpainting.sweep.cells import scattered, stacked
from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.inpainting.sweep.lookup import FEATURES, IN_VIEW, STATS, Places
from viewmend.inpainting.sweep.place_net import PlaceNet
from viewmend.inpainting.sweep.pyramids import Rig
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio, StudioConfig


@pytest.fixture
def places():
    """150 rays through 3 places before 5 cameras, each of which sees two thirds of them; one place nobody sees."""
    torch.manual_seed(3)
    seen = (torch.rand(150, 3, 5) > 1 / 3).float()
    seen[7, 1] = 0
    features = torch.rand(150, 3, 5, FEATURES) * seen[..., None]
    features[..., IN_VIEW] = seen
    prior = torch.rand(150, 3, 5) * seen
    return Places(features, prior / prior.sum(2, keepdim=True).clamp_min(1e-6), torch.rand(150, 3, STATS))


@pytest.mark.parametrize("own_prior", [True, False])
def test_the_compiled_loop_weighs_as_torch_does(places, own_prior):
    torch.manual_seed(0)
    net, prior = PlaceNet(24, 12), None if own_prior else torch.rand(150, 3, 5)
    with torch.no_grad():
        fast = net(places, prior)
    slow = net(places, prior)
    for name, own, wanted in zip(fast._fields, fast, slow, strict=True):
        torch.testing.assert_close(own, wanted.detach(), atol=1e-5, rtol=1e-5, msg=lambda m, name=name: f"{name}: {m}")
    seen = places.features[..., IN_VIEW].amax(2)
    assert seen[7, 1] == 0
    torch.testing.assert_close(fast.trust.sum(2), seen, atol=1e-5, rtol=0)


def test_what_is_looked_up_is_not_changed(places):
    before = [part.clone() for part in places]
    with torch.no_grad():
        PlaceNet(24, 12)(places)
    assert all(torch.equal(part, old) for part, old in zip(places, before, strict=True))


def test_a_view_is_read_alike_however_many_rays_are_weighed_at_once(monkeypatch):
    frame = Studio(StudioConfig(seed=7, cameras=5, frames=1, size_px=64)).read(0)
    torch.manual_seed(0)
    net = SweepNet(SweepConfig(num_views=3, width=8, place_channels=4, features=8, fine_features=8))
    stream = Stream(net, StreamConfig(fit_rig=False))
    stream.push(frame.without(frame.cameras.names[1:2]))
    camera = frame.cameras.select(frame.cameras.names[1:2])
    whole = stream.view(camera).completed
    monkeypatch.setattr(Rig, "rays_at_once", 29)
    parts = stream.view(camera).completed
    assert (whole.rgb - whole.view.rgb).abs().max() > 0.05
    torch.testing.assert_close(parts.rgb, whole.rgb, atol=1e-5, rtol=0)


def test_images_are_stacked_as_convolutions_want_them():
    points = torch.tensor([[0, 1], [2, 3]])
    one, two = scattered(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), points, torch.Size((3, 4))), torch.rand(3, 3, 4)
    whole = stacked(one, two)
    assert torch.equal(whole, torch.cat([one, two])[None])
    assert whole.is_contiguous(memory_format=torch.channels_last) and whole.stride(0) == whole[0].numel()
