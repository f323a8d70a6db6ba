"""What is written for RIFTCast is what its reader, and its own arithmetic, make the same capture of."""

import json

import numpy as np
import pytest
import torch
from reference.ball import BallCapture, ring
from reference.foreign_studios import write_easyvolcap
from reference.random_rigs import named, random_rig

from viewmend.capture.plain import open_capture
from viewmend.capture.plain_writer import write_capture
from viewmend.cli import main


@pytest.fixture
def ball(tmp_path):
    source = BallCapture(ring(4))
    write_capture(source, tmp_path / "plain", images="png")
    file = tmp_path / "plain/cameras.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"up": [0.0, 0.6, 0.8]}))
    return tmp_path / "plain"


def test_a_capture_goes_to_riftcast_and_back(ball, tmp_path):
    assert main(["convert", str(ball), str(tmp_path / "out"), "--to", "riftcast"]) == 0
    before = open_capture(ball)
    for path in (tmp_path / "out", tmp_path / "out/dataset.json"):
        after = open_capture(path)
        assert after.cameras.names == tuple(str(n) for n in range(4))
        torch.testing.assert_close(after.cameras.K, before.cameras.K)
        torch.testing.assert_close(after.cameras.camera_from_world, before.cameras.camera_from_world)
        one, other = before.read(0), after.read(0)
        assert one.mask is not None and torch.equal(one.mask > 127, other.mask == 255)
        assert (one.rgb.float() - other.rgb.float()).abs().mean() < 2  # JPEG
        assert before.up is not None and after.up is not None
        torch.testing.assert_close(after.up, before.up, atol=1e-6, rtol=0)


def test_the_programs_frame_has_y_up_and_its_cube_the_subject(ball, tmp_path):
    """V_gl = D V_file D to_world: the program's own formula, of a point of the program's frame."""
    assert main(["convert", str(ball), str(tmp_path / "out"), "--to", "riftcast"]) == 0
    meta = json.loads((tmp_path / "out/dataset.json").read_text())
    stored = json.loads((tmp_path / "out/calibration.json").read_text())["cameras"][1]
    D = np.diag([1.0, -1, -1, 1])
    to_world = np.array(meta["dataset"]["to_world"]).reshape(4, 4)
    view = D @ np.array(stored["extrinsics"]["view_matrix"]).reshape(4, 4) @ D @ to_world
    point = np.array([0.1, 0.7, -0.2, 1.0])
    capture = open_capture(ball)
    in_world = (D @ to_world @ point)[:3]
    expected = capture.cameras.camera_from_world[1].double().numpy() @ [*in_world, 1.0]
    np.testing.assert_allclose(view @ point, D @ expected, atol=1e-5)
    assert capture.up is not None
    np.testing.assert_allclose((D @ to_world)[:3, 1], capture.up, atol=1e-6)
    center, half = np.array(meta["volume"]["position"]), meta["volume"]["scale"]
    frame = capture.read(0)
    assert frame.mask is not None
    in_cube = (D @ to_world)[:3, :3] @ center
    uv = (
        capture.cameras.K[1].double().numpy()
        @ (capture.cameras.camera_from_world[1].double().numpy() @ [*in_cube, 1])[:3]
    )
    assert 0.01 < half < 10 and int(frame.mask[1, int(uv[1] / uv[2]), int(uv[0] / uv[2])]) == 255


def test_what_riftcast_cannot_have_is_refused(ball, tmp_path, capsys):
    rig = named([c | {"width": 20, "height": 16} for c in random_rig(3, 3)], "{:02d}")
    write_easyvolcap(tmp_path / "gaps", rig, ["000000", "000001"], {(rig[0]["name"], "000001")})
    write_easyvolcap(tmp_path / "sizes", [rig[0] | {"width": 24}, *rig[1:]], ["000000"])
    write_easyvolcap(tmp_path / "none", rig, ["000000"])
    for file in (tmp_path / "none/masks").glob("*/*.png"):
        file.unlink()
    for folder in (tmp_path / "none/masks").iterdir():
        folder.rmdir()
    (tmp_path / "none/masks").rmdir()
    for name, message in (
        ("gaps", "expected all cameras, got 2 of 3"),
        ("sizes", "expected images of one size"),
        ("none", "expected masks, without which RIFTCast has no hull"),
    ):
        assert main(["convert", str(tmp_path / name), str(tmp_path / "out"), "--to", "riftcast"]) == 2
        assert message in capsys.readouterr().err and not (tmp_path / "out").exists()
