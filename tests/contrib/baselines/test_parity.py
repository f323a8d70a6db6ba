"""Do the baselines compute what the published networks compute? `viewmend evaluate parity`, and what it refuses."""

import json

import numpy as np
import pytest
import torch

from viewmend import cli
from viewmend.contrib.baselines import parity
from viewmend.contrib.baselines.parity import ParityFileError, check, read_case, recipe_input, recipe_weights, run

FILES = ("dstt_t5", "dstt_om_4", "fuseformer_t5", "fuseformer_om_4", "e2fgvi_t5_local3", "e2fgvi_hq_t5_local3")


def write(path, name="DSTT", frames=1, seed=3, n_local=0, output=None, **changes):
    """A parity file of ours: what our own network returns, or `output`."""
    if output is None:
        output = run(name, frames, seed, n_local).numpy()
    fields = {
        "name": name,
        "frames": frames,
        "seed": seed,
        "n_local": n_local,
        "output": output[..., ::6, ::6],
        "mean": output.mean((1, 2, 3)),
        "std": output.std((1, 2, 3)),
    }
    np.savez_compressed(path, **{key: value for key, value in (fields | changes).items() if value is not None})
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_the_baselines_compute_what_the_published_networks_do(name, shared):
    result = check(shared / "parity" / f"{name}.npz")
    # Rounding is 1e-5 at most; an epsilon of a norm, or a border read differently, is 1e-3 and more.
    assert result.passed and result.difference < 5e-5


def test_the_quickest_published_case_is_met_each_time(shared, capsys):
    path = shared / "parity" / "dstt_om_4.npz"
    assert cli.main(["evaluate", "parity", str(path), "--json"]) == 0
    [result] = json.loads(capsys.readouterr().out)
    assert result["name"] == "DSTT_OM" and result["frames"] == 4 and result["passed"] and result["difference"] < 5e-5


def test_every_value_of_the_recipe_follows_from_seed_and_key():
    assert not torch.equal(recipe_input(1, 1), recipe_input(1, 2))
    holes = recipe_input(3, 1)[2]
    assert not holes[:, 94:154, 178:258].any() and bool((holes.abs().max(0).values[93, 178:258] > 0).all())
    network = parity.NETWORKS["FuseFormer"][0]()
    one, other = recipe_weights(network, 1), recipe_weights(network, 2)
    assert not torch.equal(one["ss.embedding.weight"], other["ss.embedding.weight"])
    assert one["transformer.0.norm1.weight"].mean() == pytest.approx(1, abs=0.02)
    assert one["transformer.0.norm1.bias"].std() == pytest.approx(0.1, rel=0.1)
    assert one["sc.bias"].std() == pytest.approx(0.1, rel=0.01)
    assert one["ss.embedding.weight"].std() == pytest.approx((128 * 49) ** -0.5, rel=0.01)


@pytest.mark.slow
def test_one_frame_alone_and_all_frames_local_can_be_compared(tmp_path):
    for frames, n_local in ((1, 1), (2, 2)):
        result = check(write(tmp_path / "e.npz", "E2FGVI", frames, 7, n_local))
        assert result.passed and result.frames == frames and result.seed == 7
    # The same frames as references give something else: n_local is not ignored.
    assert not check(write(tmp_path / "e.npz", "E2FGVI", 2, 7, 1, run("E2FGVI", 2, 7, 2).numpy())).passed


def test_n_local_is_of_networks_that_have_one(tmp_path):
    blank = np.zeros((1, 3, 240, 432), np.float32)
    path = write(tmp_path / "old.npz", output=blank, n_local=None, name=np.bytes_(b"DSTT"), frames=np.array([1]))
    assert read_case(path).name == "DSTT" and read_case(path).frames == 1


def test_outputs_that_differ_fail(tmp_path, capsys):
    output = run("DSTT", 1, 3).numpy()
    wrong = output.copy()
    wrong[0, 0, 0, 0] += 0.002
    right, wrong, other = (
        str(write(tmp_path / f"{name}.npz", output=made, **changes))
        for name, made, changes in (("right", output, {}), ("wrong", wrong, {}), ("other", output, {"seed": 4}))
    )
    assert cli.main(["evaluate", "parity", right, wrong, other]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.rsplit(": ", 2)[-1] for line in lines] == ["passed", "above 0.001", "above 0.001"]
    assert "largest difference 2.00e-03" in lines[1]
    nan = output.copy()
    nan[0, 0, 0, 0] = np.nan
    assert not check(write(tmp_path / "nan.npz", output=nan)).passed


BLANK = np.zeros((1, 3, 240, 432), np.float32)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "ProPainter"}, "expected a network among .*, got 'ProPainter'"),
        ({"name": "E2FGVI"}, "expected an n_local of 1 to the 1 frames, got 0"),
        ({"name": "E2FGVI", "n_local": None}, "expected an n_local of 1 to the 1 frames, got 0"),
        ({"name": "E2FGVI_HQ", "n_local": 2}, "expected an n_local of 1 to the 1 frames, got 2"),
        ({"frames": 2}, "expected an output of"),
        ({"frames": 0}, "expected 1 or more frames"),
        ({"seed": -1}, "a seed of 0 to"),
        ({"frames": [1, 2]}, "regenerate the file"),
        ({"output": BLANK[:, :, ::4, ::4]}, "expected an output of"),
        ({"output": np.array(["x"])}, "regenerate the file"),
        ({"std": None}, "expected the fields .* missing"),
    ],
)
def test_files_of_other_contents_are_refused_before_anything_runs(changes, message, tmp_path):
    path = tmp_path / "x.npz"
    write(path, output=BLANK)
    values = dict(np.load(path)) | changes
    np.savez(path, **{key: value for key, value in values.items() if value is not None})
    with pytest.raises(ParityFileError, match=message) as caught:
        read_case(path)
    assert str(path) in str(caught.value)


def test_damaged_and_absent_files_are_one_clear_error(tmp_path, capsys):
    whole = write(tmp_path / "whole.npz", output=BLANK).read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "flipped.npz").write_bytes(whole[:400] + bytes(200) + whole[600:])
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "text.npz").write_text("no archive")
    np.save(tmp_path / "array.npy", BLANK)
    np.savez(tmp_path / "pickled.npz", **{field: np.array([{}], dtype=object) for field in parity.FIELDS})
    names = ("cut.npz", "flipped.npz", "empty.npz", "text.npz", "array.npy", "pickled.npz", "absent.npz", ".")
    for name in names:
        assert cli.main(["evaluate", "parity", str(tmp_path / name)]) == 2, name
        out, message = capsys.readouterr()
        assert out == "" and message.count("\n") == 1 and "expected" in message, name
    assert cli.main(["evaluate", "parity"]) == 2
