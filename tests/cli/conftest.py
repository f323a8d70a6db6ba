"""A small capture of a ball, and `viewmend mend` on it."""

import json
import shutil

import pytest
from reference.ball import BallCapture, camera_at
from reference.capture_folder import edit_description
from reference.computed_once import compute_once

from viewmend.cli import main
from viewmend.data.native_writer import write_capture
from viewmend.geometry.cameras import concatenate_cameras


@pytest.fixture(autouse=True)
def _computed_once(monkeypatch):
    """Checks of a capture and people of the studio are computed once, not in each test."""
    compute_once(monkeypatch)


def rig():
    """Six cameras about the ball at different heights, and `held` between two of them."""
    around = [
        camera_at(60 * n, f"c{n}", height_m=height)
        for n, height in enumerate((0.0, 1.2, -0.8, 0.6, 1.4, -1.0))
    ]
    return concatenate_cameras([*around, camera_at(75, "held", height_m=0.3)])


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("mend") / "ball"
    write_capture(BallCapture(rig()), path, images="png")
    return path


@pytest.fixture
def shifted(folder, tmp_path):
    """The same capture, whose calibration says that all images are a pixel further right."""
    path = shutil.copytree(folder, tmp_path / "shifted")

    def change(content):
        for camera in content["cameras"]:
            camera["K"][0][2] += 1.0

    edit_description(path, change)
    return path


@pytest.fixture
def mend(capsys):
    """Runs the command: exit code, JSON and messages."""

    def run(folder, out, *arguments):
        model = [] if "--model" in arguments else ["--model", "telea"]
        code = main(["mend", str(folder), "--out", str(out), "--json", *map(str, arguments), *model])
        said = capsys.readouterr()
        return code, json.loads(said.out) if code == 0 else said.out, said.err

    return run
