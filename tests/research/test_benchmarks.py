"""What the benchmarks share: waiting for the right device, files of results, and scores of masks and views."""

from dataclasses import replace

import benchmarks_path  # noqa: F401
import measure
import torch
from masks import overlaps
from reference.ball import BallCapture, ring


def test_the_device_that_is_timed_is_waited_for_and_named(monkeypatch):
    asked = []
    monkeypatch.setattr(torch.cuda, "synchronize", asked.append)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"the GPU of {device}")
    measure.timed(lambda: None, runs=1, warm_up=0, device="cuda:1")
    assert asked == ["cuda:1", "cuda:1"]
    assert measure.machine("cuda:1")["device"] == "the GPU of cuda:1"
    measure.synchronise("cpu")
    assert len(asked) == 2


def test_empty_masks_and_absent_cameras_have_no_overlap():
    frame = BallCapture(ring(4)).read(0)
    empty = frame.mask.clone()
    empty[1:3] = 0
    found = replace(frame, mask=empty)
    right = replace(frame, mask=torch.where(torch.arange(4)[:, None, None] == 1, 0, frame.mask).byte())
    assert overlaps(found, right.without(["c3"])) == {"c0": 1.0, "c2": 0.0}
