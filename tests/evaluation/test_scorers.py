"""Networks compare images and videos only where their weights are; what they need travels with the cells."""

import pytest
import torch

from viewmend.evaluation import scorers
from viewmend.evaluation.averages import tables, vfid
from viewmend.evaluation.cells import CellStore
from viewmend.evaluation.runner import run_evaluation
from viewmend.evaluation.scene_run import RunSettings
from viewmend.evaluation.scorers import CLIP_FRAMES, KINDS, VideoFeatures, available_networks
from viewmend.metrics.i3d import I3d
from viewmend.metrics.vfid import frechet_distance, video_features
from viewmend.metrics.weights import MissingWeightsError

METHODS = ("telea", "unfilled")


@pytest.fixture(scope="module")
def i3d():
    torch.manual_seed(0)
    return I3d().eval()


@pytest.fixture
def networks(monkeypatch, i3d):
    def missing(device):
        raise MissingWeightsError("no file")

    def difference(device):
        return lambda image, truth: (image - truth).abs().mean(0)

    table = {
        "lpips-alex": ("lpips_alex", difference),
        "lpips-vgg": ("lpips_vgg", missing),
        "i3d": ("i3d", lambda d: i3d),
    }
    monkeypatch.setattr(scorers, "NETWORKS", table)


def test_those_without_weights_are_left_out_with_their_reason(networks):
    assert available_networks() == (("lpips-alex", "i3d"), {"lpips-vgg": "no file"})


def test_streams_are_cut_into_videos(i3d, rng):
    frames = torch.rand(CLIP_FRAMES + 8, 3, 40, 44, generator=rng)
    holes = torch.rand(40, 44, generator=rng) > 0.5
    videos, shorter = VideoFeatures(i3d), VideoFeatures(i3d)
    for number, frame in enumerate(frames):
        videos.add(frame, holes)
        if number < CLIP_FRAMES + 1:
            shorter.add(frame, holes)
    found = videos.features()
    assert {len(v) for v in (shorter.features() or {}).values()} == {1}, "one frame is no video beside sixteen"
    assert found is not None and {kind: len(v) for kind, v in found.items()} == dict.fromkeys(KINDS, 2)
    expected = video_features(i3d, list(frames[CLIP_FRAMES:] * holes), "train")
    torch.testing.assert_close(torch.from_numpy(found["masked_train"][1]), expected)
    expected = video_features(i3d, list(frames[:CLIP_FRAMES]), "eval")
    torch.testing.assert_close(torch.from_numpy(found["whole_eval"][0]), expected)
    assert VideoFeatures(None).features() is None


def test_cells_remember_features_and_tables_have_the_distance(networks, small_scenes, tmp_path):
    settings = RunSettings(networks=("lpips-alex", "i3d"))

    def run():
        steps = run_evaluation(small_scenes[:2], METHODS, CellStore(tmp_path), settings)
        return sorted((cell for found in steps for cell in found), key=lambda c: (c.key.scene, c.key.method))

    cells, again = run(), run()
    assert all(frame.lpips_alex_holes > 0 and frame.lpips_vgg_holes is None for c in cells for frame in c.frames)
    for first, second in zip(cells, again, strict=True):
        assert all((first.features[kind] == second.features[kind]).all() for kind in KINDS)
        assert all((first.true_features[kind] == second.true_features[kind]).all() for kind in KINDS)
    (table,) = tables(again, METHODS)
    own = [c for c in cells if c.key.method == "telea"]
    sides = [torch.from_numpy(getattr(c, name)["whole_eval"]) for name in ("features", "true_features") for c in own]
    expected = frechet_distance(torch.cat(sides[:2]), torch.cat(sides[2:]))
    assert table.rows[0].vfid.whole_eval == pytest.approx(expected) and expected > 0
    assert vfid(cells[:1]).whole_eval is None
    for path in tmp_path.glob("*.npz"):
        path.write_bytes(path.read_bytes()[:100])
    assert tables(run(), METHODS)[0].rows[0].vfid.whole_eval is None


def test_without_networks_there_is_no_number(small_scenes, tmp_path):
    (cells,) = run_evaluation(small_scenes[:1], METHODS, CellStore(tmp_path))
    assert all(f.lpips_alex_whole is None for c in cells for f in c.frames)
    assert tables(cells, METHODS)[0].rows[0].vfid.whole_eval is None
