"""What a camera of a capture saw that is left out is the truth, and helps nobody before."""

import shutil

import cv2
import numpy as np
import pytest
import torch
from reference.ball import BallCapture, ring

from viewmend.data.holdout.capture_scenes import capture_set
from viewmend.data.native_writer import write_capture


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A ball, and the same ball with the images and masks of one camera shifted by nine pixels."""
    exact = tmp_path_factory.mktemp("scenes") / "ball"
    write_capture(BallCapture(ring(6)), exact, images="png")
    other = exact.with_name("other")
    shutil.copytree(exact, other)
    for kind in ("image", "mask"):
        for file in (other / kind / "c2").iterdir():
            cv2.imwrite(str(file), np.roll(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), 9, 1))
    return exact, other


def test_what_the_camera_left_out_saw_changes_the_truth_alone(folders):
    exact, other = (list(capture_set(folder)[2].frames("cpu")) for folder in folders)
    assert [frame.truth.cameras.names for frame in exact] == [("c2",)] * 2
    for one, two in zip(exact, other, strict=True):
        assert one.inputs.cameras.names == two.inputs.cameras.names == ("c0", "c1", "c3", "c4", "c5")
        assert torch.equal(one.inputs.cameras.K, two.inputs.cameras.K), "the rig is aligned without it"
        assert torch.equal(one.inputs.rgb, two.inputs.rgb) and torch.equal(one.inputs.mask, two.inputs.mask)
        assert torch.equal(one.truth.cameras.K, two.truth.cameras.K)
        assert torch.equal(one.truth.rgb.roll(9, 3), two.truth.rgb) and not torch.equal(one.truth.rgb, two.truth.rgb)
    assert not torch.equal(exact[0].truth.rgb, exact[1].truth.rgb), "each time is another"


def test_it_is_aligned_by_those_that_are_looked_at(folders):
    """The camera that lies beside pulls all others with it, where it is not left out."""
    pulled, clean = (next(capture_set(folders[1])[held].frames("cpu")).inputs.cameras for held in (0, 2))
    assert float((pulled.select(["c3"]).K - clean.select(["c3"]).K).abs().max()) > 0.3
