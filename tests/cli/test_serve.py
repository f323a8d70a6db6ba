"""`viewmend serve` as a person starts it."""

import os
import re
import signal
import subprocess
import sys
import urllib.request

import pytest

from viewmend.cli import serve


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_one_command_and_a_picture(sent):
    options = ["--port", "0", "--size", "96", "--cameras", "4", "--frames", "2", "--model", "nearest"]
    options += ["--broadcast", "96x64"]
    command = [sys.executable, "-m", "viewmend", "serve", *options]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as server:
        assert server.stderr is not None
        try:
            address = re.search(r"http://127\.0\.0\.1:\d+", server.stderr.readline())
            assert address is not None
            with urllib.request.urlopen(f"{address[0]}/frame.jpg?width=64&height=64", timeout=60) as answer:
                assert answer.read(2) == b"\xff\xd8"
            assert f"{address[0]}/watch" in server.stderr.readline()
            with urllib.request.urlopen(f"{address[0]}/broadcast/live.m3u8", timeout=60) as answer:
                assert answer.read().startswith(b"#EXTM3U")
            server.send_signal(sent)
            assert server.wait(20) in (0, 130, 143)
            assert "Traceback" not in server.stderr.read()
        finally:
            if server.poll() is None:
                server.kill()


def test_a_token_need_not_be_among_the_arguments(tmp_path, monkeypatch):
    file = tmp_path / "token"
    file.write_text("from a file, long enough\nand more\n")
    assert serve._token(serve.Options()) is None
    monkeypatch.setenv("VIEWMEND_TOKEN", "from the environment")
    assert serve._token(serve.Options()) == "from the environment"
    assert serve._token(serve.Options(token_file=file)) == "from a file, long enough"
    assert serve._token(serve.Options(token="from the arguments")) == "from the arguments"
    with pytest.raises(ValueError, match="got both"):
        serve._token(serve.Options(token="from the arguments", token_file=file))
    file.write_text("\n")
    with pytest.raises(ValueError, match="expected the token in its first line"):
        serve._token(serve.Options(token_file=file))
