"""`viewmend serve` as a person starts it."""

import os
import re
import signal
import subprocess
import sys
import urllib.request

import pytest

from viewmend.cli import main, serve


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere"], "nowhere"),
        (["--host", "0.0.0.0"], "expected --token with --host 0.0.0.0"),
        (["--port", "-1"], "--port"),
        (["--budget-ms", "nan"], "--budget-ms"),
        (["--fps", "0"], "--fps"),
        (["--model", "nothing"], "nothing"),
        (["--device", "tpu"], "tpu"),
        (["--broadcast", "1280"], "expected --broadcast WIDTHxHEIGHT"),
        (["--broadcast", "1280x719"], "even"),
        (["--broadcast", "1280x14"], "from 16"),
        (["--broadcast", "4096x4096"], "2048"),
        (["--broadcast", "1280x720", "--ray", "local"], "--broadcast or --ray"),
    ],
)
def test_what_cannot_be_served_is_one_line(capsys, arguments, words):
    assert main(["serve", *arguments]) == 2
    message = capsys.readouterr().err
    assert words in message and message.count("\n") == 1


def test_a_capture_without_masks_is_refused(tmp_path, capsys):
    import json

    assert main(["studio", str(tmp_path / "out"), "--cameras", "4", "--frames", "1", "--size", "32"]) == 0
    folder = tmp_path / "out" / "scene_00000"
    calibration = json.loads((folder / "cameras.json").read_text())
    for camera in calibration["cameras"]:
        del camera["mask"]
    (folder / "cameras.json").write_text(json.dumps(calibration))
    capsys.readouterr()
    assert main(["serve", str(folder)]) == 2
    assert "expected a 'mask' for every camera" in capsys.readouterr().err


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
