"""Baselines by name: what each name runs, with which weights, and never with random ones."""

import os
from dataclasses import replace

import pytest
import torch
from models.plates import Rig
from models.plates import view as plate
from safetensors.torch import save_file
from torch import nn

from viewmend.contrib.baselines.e2fgvi import E2FGVIHQ
from viewmend.contrib.baselines.online import OnlineInpainter
from viewmend.contrib.baselines.published import NETWORKS, RiftCast, make_baseline
from viewmend.contrib.baselines.token_transformers import DSTT
from viewmend.metrics.weights import FOLDERS_VARIABLE
from viewmend.models.registry import MethodMissing, make_method
from viewmend.utils.weight_files import MissingWeightsError, WeightsError


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A folder with DSTT's weights, its authors' and ours, and E2FGVI-HQ's."""
    folder = tmp_path_factory.mktemp("weights")
    (folder / "finetuned" / "dstt").mkdir(parents=True)
    torch.manual_seed(0)
    torch.save({"netG": DSTT().state_dict()}, folder / "DSTT.pth")
    torch.save(E2FGVIHQ().state_dict(), folder / "E2FGVI-HQ-CVPR22.pth")
    save_file(DSTT().state_dict(), folder / "finetuned" / "dstt" / "model.safetensors")
    return folder


@pytest.fixture(autouse=True)
def places(weights, tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDERS_VARIABLE, os.pathsep.join([str(tmp_path), str(weights)]))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))


@pytest.mark.parametrize("variant", ["o", "om"])
@pytest.mark.parametrize("framing", ["def", "win", "mul"])
def test_a_name_says_how_a_network_is_run(variant, framing):
    inpainter = make_baseline(f"dstt-{variant}-{framing}")
    assert isinstance(inpainter, OnlineInpainter) and isinstance(inpainter.network, DSTT)
    assert inpainter.config.framing == framing and inpainter.config.memory == (variant == "om")
    assert inpainter.config.sampling.grid == "absolute" and inpainter.config.size_px == (240, 432)


def test_names_say_which_weights(weights):
    official = torch.load(weights / "DSTT.pth", weights_only=True)["netG"]["encoder.0.weight"]
    tuned, relative = make_baseline("dstt-o-win-finetuned"), make_baseline("dstt-om-mul-relative-finetuned")
    for inpainter in (tuned, relative):
        assert not torch.equal(inpainter.network.encoder[0].weight, official)
    assert relative.config.sampling.grid == "relative"
    for name in ("dstt-o-def", f"dstt-o-def@{weights / 'DSTT.pth'}"):
        assert torch.equal(make_baseline(name).network.encoder[0].weight, official)
    by_folder = make_baseline(f"dstt-o-def@{weights / 'finetuned' / 'dstt'}")
    assert torch.equal(by_folder.network.encoder[0].weight, tuned.network.encoder[0].weight)
    assert isinstance(make_baseline("e2fgvi-hq-om-win").network, E2FGVIHQ)


def test_riftcast_is_dstt_right_and_as_published():
    right, published = make_baseline("riftcast"), make_baseline("riftcast-published")
    assert isinstance(right, RiftCast) and isinstance(published, RiftCast)
    assert (right.as_published, published.as_published) == (False, True)


@pytest.mark.parametrize("name", ["fuseformer-o-def", "e2fgvi-om-mul-relative", "e2fgvi-hq-o-win-finetuned"])
def test_without_weights_nothing_is_made(name, tmp_path):
    with pytest.raises(MissingWeightsError, match="found none; get it from") as said:
        make_baseline(name)
    assert str(tmp_path) in str(said.value)


def test_another_networks_weights_are_refused(weights):
    with pytest.raises(WeightsError, match="the 243 tensors of E2FGVI, got 244"):
        make_baseline(f"e2fgvi-o-def@{weights / 'E2FGVI-HQ-CVPR22.pth'}")
    with pytest.raises(WeightsError, match="found none; check the path"):
        make_baseline(f"dstt-o-def@{weights / 'absent'}")


@pytest.mark.parametrize("name", ["dstt", "dstt-o", "dstt-x-def", "dstt-o-all", "sttn-o-def", "dstt-o-def@", "telea"])
def test_other_names_are_none(name):
    with pytest.raises(ValueError, match="expected a name like dstt-o-def"):
        make_baseline(name)


@pytest.mark.parametrize("network", sorted(set(NETWORKS) - {"dstt"}))
def test_every_network_is_reached_through_the_registry(network):
    with pytest.raises(MethodMissing, match="found none; get it from"):
        make_method(f"{network}-om-mul-relative-finetuned")


# RIFTCast's own inpainting: the whole view at 432x240, and a memory of six frames, right and as published.


class Counter(DSTT):
    """Remembers the time that a frame's colour says, in each block."""

    def __init__(self):
        nn.Module.__init__(self)
        self.seen = []

    def complete_remembering(self, now, memory):
        assert now.shape == (1, 3, 240, 432)
        self.seen.append([slot.flatten().tolist() for slot in memory])
        time = (now[0, 0, 0, 0] + 1) * 50
        return torch.zeros(3, 240, 432), torch.full((8, 1, 1, 1, 512), float(time.round()))


def times_view(time):
    view = plate(time, (20, 40, 30, 55))
    return replace(view, rgb=torch.full_like(view.rgb, time / 100) * (1 - view.error))


def memories(as_published, frames):
    network = Counter()
    inpainter, state = RiftCast(network, as_published), RiftCast(network).initial_state()
    for time in range(frames):
        _, state = inpainter.step(times_view(time), Rig(), state)
    return [[set(slot) for slot in memory] for memory in network.seen], state


def test_the_memory_is_of_the_last_six_frames():
    seen, state = memories(as_published=False, frames=12)
    for time, memory in enumerate(seen):
        assert memory == [{t} for t in range(max(0, time - 6), time)]
    assert len(state.slots) == 6


def test_as_published_nothing_is_remembered_before_six_frames_and_then_the_first_five_stay():
    seen, state = memories(as_published=True, frames=20)
    assert seen[:6] == [[]] * 6
    assert seen[6] == [{0}, {1}, {2}, {3}, {4}, {5}]
    # The flattened memory is rolled by one number: a slot's last one comes from the next, all others are its own.
    assert seen[7] == [{0, 1}, {1, 2}, {2, 3}, {3, 4}, {4, 5}, {6}]
    assert [min(slot) for slot in seen[19][:5]] == [0, 1, 2, 3, 4] and seen[19][5] == {18}
    assert len(state.slots) == 6


@pytest.mark.parametrize("as_published", [False, True])
def test_only_holes_change_and_they_stay_soft(as_published):
    view = plate(0)
    completed, _ = RiftCast(Counter(), as_published).step(view, Rig(), RiftCast(Counter()).initial_state())
    untouched = view.error == 0
    assert torch.equal(completed.rgb[:, untouched], view.rgb[:, untouched])
    assert torch.allclose(completed.rgb[:, view.error == 1], torch.tensor(0.5))
    soft = view.error == 0.5
    assert torch.allclose(completed.rgb[:, soft], 0.25 + 0.5 * view.rgb[:, soft])
