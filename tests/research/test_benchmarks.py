"""What the benchmarks share: waiting for the right device, files of results, and scores of masks and views."""


import benchmarks_path  # noqa: F401
import measure
import torch


def test_the_device_that_is_timed_is_waited_for_and_named(monkeypatch):
    asked = []
    monkeypatch.setattr(torch.cuda, "synchronize", asked.append)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"the GPU of {device}")
    measure.timed(lambda: None, runs=1, warm_up=0, device="cuda:1")
    assert asked == ["cuda:1", "cuda:1"]
    assert measure.machine("cuda:1")["device"] == "the GPU of cuda:1"
    measure.synchronise("cpu")
    assert len(asked) == 2
