"""Calls from file to file, and which of them go up."""

import importlib

from trace_calls import CallTrace


def test_calls_of_a_higher_layer_go_up(tmp_path, monkeypatch):
    (tmp_path / "traced_low.py").write_text("def call(function):\n    return function()\n")
    (tmp_path / "traced_high.py").write_text(
        "import traced_low\n"
        "def start():\n    return [traced_low.call(finish) for _ in range(2)]\n"
        "def finish():\n    return 1\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    trace = CallTrace(tmp_path, ["traced_high | other", "traced_low"])
    start = importlib.import_module("traced_high").start
    with trace.recording():
        start()
    calls = [str(call) for call in trace.hand_overs]
    assert calls == ["traced_high.py -> traced_low.py:call", "traced_low.py -> traced_high.py:finish"]
    assert trace.up == trace.hand_overs[1:] and trace.files == {"traced_high.py", "traced_low.py"}
