"""Cameras from pictures of a board, and from silhouettes, both rendered by cameras that are known."""

import json
import re
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from reference.capture_folder import edit_description
from reference.computed_once import carve_coarsely
from reference.filmed_board import photograph, waved

from viewmend.cli import calibrate as calibrate_command
from viewmend.cli import main
from viewmend.data.capture_folder import open_capture, pinhole_cameras
from viewmend.data.errors import CaptureError
from viewmend.data.native_format import read_calibration
from viewmend.data.native_writer import write_capture
from viewmend.data.source import CaptureSubset
from viewmend.geometry.cameras import project
from viewmend.preprocess.calibration import cross_validation
from viewmend.preprocess.calibration.board import Corners, open_footage, parse_board
from viewmend.preprocess.calibration.bundle import calibrate
from viewmend.preprocess.calibration.cross_validation import HeldOutIou, best_hold, held_out_residual_px
from viewmend.preprocess.calibration.silhouettes import HOLDS, Refinement, align_rig
from viewmend.studio.rigs import ring_rig
from viewmend.studio.stage import Studio, StudioConfig

BOARD, SMALL_BOARD, DICTIONARY = "8x6:0.12:0.09", "6x5:0.16:0.12", "DICT_5X5_1000"
TIMES = 14
BENT = np.array([-0.06, 0.02, 0, 0, 0])
NOISE = 2.0


@pytest.fixture(autouse=True)
def _carved_coarsely(monkeypatch):
    monkeypatch.setattr(cross_validation, "reconstruct", carve_coarsely)


def film(folder, cameras, board, count, yaw_rad=np.pi, bent=BENT, seed=0):
    """Each camera's images of a board that is carried through the stage, a folder each."""
    board, rng = parse_board(board, DICTIONARY), np.random.default_rng(seed)
    size_m = board.columns * board.square_m, board.rows * board.square_m
    K, poses = cameras.K.double().numpy(), cameras.camera_from_world.double().numpy()
    sizes = cameras.size_px.tolist()
    for time, pose in enumerate(waved(count, size_m, seed, yaw_rad)):
        for view, name in enumerate(cameras.names):
            (folder / name).mkdir(parents=True, exist_ok=True)
            image = photograph(board, K[view], bent, poses[view] @ pose, sizes[view], rays_per_side=2)
            image = np.full(sizes[view][::-1], 110, np.uint8) if image is None else image
            noisy = (0.85 * image + 10 + rng.normal(0, NOISE, image.shape)).clip(0, 255).astype(np.uint8)
            assert cv2.imwrite(str(folder / name / f"{time:03d}.png"), noisy)


def over_the_stage_px(found, cameras):
    """How far points of the whole stage are from where the true cameras see them, mean of each camera."""
    points = torch.from_numpy(
        np.random.default_rng(1).uniform([-0.7, 0, -0.7], [0.7, 1.9, 0.7], (1000, 3))
    ).float()
    seen = project(points, align_rig(found, cameras, points))[0]
    return (seen - project(points, cameras)[0]).norm(dim=-1).mean(1)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    rig = ring_rig(8, (320, 384), seed=3)[[0, 1, 7]]
    folder = tmp_path_factory.mktemp("board")
    film(folder, rig, SMALL_BOARD, TIMES, yaw_rad=0.4)
    return folder, rig


def test_cameras_are_found_and_written(filmed, tmp_path, capsys):
    folder, rig = filmed
    out = tmp_path / "out"
    assert main(["calibrate", str(folder), str(out), "--board", SMALL_BOARD, "--every", "1", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert list(figures) == list(rig.names) and all(
        f["rms_px"] < 0.3 and f["images"] > 5 for f in figures.values()
    )
    calibration = read_calibration(out)
    assert calibration.cameras[1].image == f"{rig.names[1]}/{{frame}}.png"
    assert over_the_stage_px(pinhole_cameras(calibration.cameras), rig).mean() < 1.0
    baseline_m = np.linalg.norm(calibration.cameras[1].t_m)
    assert baseline_m == pytest.approx(float((rig.centers[1] - rig.centers[0]).norm()), rel=0.005)
    assert calibration.up[1] < -0.8
    assert cv2.imread(str(out / "residuals.png")).shape[1] > 900


@pytest.mark.slow
def test_a_ring_of_eight_is_found_to_a_fifth_of_a_pixel(tmp_path):
    rig = ring_rig(8, (512, 612), seed=3)
    film(tmp_path / "board", rig, BOARD, 80, bent=np.zeros(5))
    out = str(tmp_path / "out")
    assert main(["calibrate", str(tmp_path / "board"), out, "--board", BOARD, "--every", "1"]) == 0
    off_px = over_the_stage_px(pinhole_cameras(read_calibration(tmp_path / "out").cameras), rig)
    assert off_px.max() < 0.2


WRONG = {
    "words": (["--board", "8x6"], "COLUMNSxROWS:SQUARE_M:MARKER_M"),
    "markers": (["--board", "8x6:0.1:0.2"], "markers smaller than squares"),
    "dictionary": (["--board", BOARD, "--dictionary", "5X5"], "a dictionary of OpenCV"),
    "another dictionary": (
        ["--board", BOARD, "--dictionary", "DICT_4X4_50"],
        "in 5 images or more, found it in 0",
    ),
    "every": (["--board", BOARD, "--every", "0"], "--every of at least 1"),
    "nothing": ([], "either --board or --silhouettes"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_one_line(filmed, tmp_path, capsys, what):
    arguments, words = WRONG[what]
    few = [] if "--every" in arguments else ["--every", "9"]
    assert main(["calibrate", str(filmed[0]), str(tmp_path / "out"), *arguments, *few]) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert words in message and not any(tmp_path.iterdir())


def test_a_folder_without_footage_is_said(tmp_path, capsys):
    assert main(["calibrate", str(tmp_path), str(tmp_path / "out"), "--board", BOARD]) == 2
    assert "expected two or more videos" in capsys.readouterr().err


@pytest.mark.parametrize(("tilt_rad", "determined"), [(0.0, False), (0.3, True)])
def test_a_board_that_is_hardly_tilted_determines_no_focal_length(rng, tilt_rad, determined):
    board = parse_board(SMALL_BOARD, DICTIONARY)
    K, seen = np.array([[400.0, 0, 160], [0, 400.0, 192], [0, 0, 1]]), {}
    for time in range(8):
        turn = tilt_rad * np.array([np.cos(time), np.sin(time), 0])
        for view in (0, 1):
            shift = np.array([0.3 * view - 0.4, -0.3, 3 + 0.1 * time])
            pixels = cv2.projectPoints(board.corners_m, turn, shift, K, np.zeros(5))[0][:, 0]
            noise = 0.1 * torch.randn(pixels.shape, generator=rng).numpy()
            seen[view, time] = Corners(np.arange(len(pixels)), pixels + noise)
    if determined:
        found = calibrate(seen, board, ("a", "b"), [(320, 384)] * 2)
        assert all(abs(camera.K[0, 0] - 400) < 10 for camera in found)
        return
    with pytest.raises(
        ValueError, match=r"camera '[ab]': .* focal length, got it to within .* tilted to all"
    ):
        calibrate(seen, board, ("a", "b"), [(320, 384)] * 2)


def test_cameras_that_never_share_a_time_are_named():
    board = parse_board(SMALL_BOARD, DICTIONARY)
    K, seen = np.array([[400.0, 0, 160], [0, 400.0, 192], [0, 0, 1]]), {}
    for time, pose in enumerate(waved(12, (0.96, 0.8), yaw_rad=0.4)):
        eye = np.array([[1.0, 0, 0, 0], [0, -1, 0, 1], [0, 0, -1, 3]])
        seen_from = eye @ pose
        pixels = cv2.projectPoints(board.corners_m, seen_from[:, :3], seen_from[:, 3], K, BENT)[0][:, 0]
        seen[time % 2, time] = Corners(np.arange(len(pixels)), pixels)
    with pytest.raises(
        ValueError, match="camera 'b': expected the board in it and in another camera at the same time"
    ):
        calibrate(seen, board, ["a", "b"], [(320, 384)] * 2)


def disturbed(folder, px=1.5):
    """Turn each camera by about so many pixels, and move it as far."""
    rng = np.random.default_rng(0)

    def change(content):
        for camera in content["cameras"]:
            focal = camera["K"][0][0]
            turn = cv2.Rodrigues(rng.normal(0, px / focal, 3))[0]
            camera["R"] = (turn @ np.array(camera["R"])).tolist()
            camera["t"] = (turn @ np.array(camera["t"]) + rng.normal(0, px / focal, 3)).tolist()

    edit_description(folder, change)


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    folder = tmp_path_factory.mktemp("studio") / "take"
    source = Studio(StudioConfig(seed=5, cameras=8, frames=2, fps=2, size_px=96))
    write_capture(source, folder, images="png")
    return folder, source.cameras


def test_silhouettes_refine_a_disturbed_rig(studio, tmp_path):
    folder = shutil.copytree(studio[0], tmp_path / "take")
    disturbed(folder)
    capture = open_capture(folder)
    refined = cross_validation.refine_all([capture.read(0), capture.read(1)], capture.bounds, HOLDS[0])
    before, after = (over_the_stage_px(c, studio[1]).mean() for c in (capture.cameras, refined.cameras))
    assert after < 0.5 * before and refined.after_px < 0.3 * refined.before_px
    moved_m = (refined.cameras.centers - capture.cameras.centers).norm(dim=1).mean()
    assert moved_m < 0.05, "the rig as a whole stays"


@pytest.mark.slow
def test_silhouettes_refine_a_studio_rig_to_a_third_of_a_pixel(tmp_path):
    rig = ring_rig(8, (512, 612), seed=3)
    source = Studio(StudioConfig(seed=5, cameras=rig, frames=60, fps=10))
    write_capture(CaptureSubset(source, range(0, 60, 15)), tmp_path / "take", images="png")
    disturbed(tmp_path / "take")
    assert main(["calibrate", str(tmp_path / "take"), str(tmp_path / "out"), "--silhouettes"]) == 0
    assert over_the_stage_px(pinhole_cameras(read_calibration(tmp_path / "out").cameras), rig).mean() < 0.3


@pytest.mark.parametrize("file", ["", "cameras.json"])
def test_what_is_refined_is_written(studio, tmp_path, capsys, monkeypatch, file):
    folder, cameras = shutil.copytree(studio[0], tmp_path / "take"), studio[1]
    disturbed(folder)
    true = lambda frames, *_: Refinement(cameras.select(frames[0].cameras.names), 0.9, 0.1)  # noqa: E731
    monkeypatch.setattr(cross_validation, "refine_by_silhouettes", true)
    monkeypatch.setattr(cross_validation, "best_hold", lambda *_: HOLDS[0])
    source = str(folder / file)
    assert main(["calibrate", source, str(tmp_path / "out"), "--silhouettes", "--num-frames", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "outlines  missed_px 0.9, refined_px 0.1" in lines and len(lines) == 4
    shutil.copy(tmp_path / "out" / "cameras.json", folder / "cameras.json")
    assert torch.allclose(
        open_capture(folder).cameras.camera_from_world, cameras.camera_from_world, atol=1e-5
    )
    assert open_capture(folder).read(1).mask is not None, "it goes where the old one was"


def test_a_calibration_that_no_refinement_betters_is_kept(studio, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        cross_validation, "refine_by_silhouettes", lambda frames, *_: Refinement(frames[0].cameras, 0.1, 0.1)
    )
    monkeypatch.setattr(cross_validation, "best_hold", lambda *_: HOLDS[0])
    arguments = ["calibrate", str(studio[0]), str(tmp_path / "out"), "--silhouettes", "--num-frames", "1"]
    assert main(arguments) == 2
    assert "keep the calibration" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_frames_that_are_not_used_are_counted(studio, tmp_path, capsys):
    folder = shutil.copytree(studio[0], tmp_path / "take")
    sorted((folder / "mask" / studio[1].names[0]).iterdir())[1].unlink()
    frames, _ = calibrate_command._frames(calibrate_command.Options(source=folder, out=tmp_path / "out"))
    assert [len(frame.cameras) for frame in frames] == [8]
    assert "of 2 chosen frames, 1 are used" in capsys.readouterr().err


@pytest.mark.parametrize(
    "names, said",
    [
        (("left.mp4", "left.mov"), "one video for each camera, got 'left.mov' and 'left.mp4'"),
        (("left.mp4", "right/0.png"), "got both ('left.mp4' and 'right')"),
    ],
)
def test_footage_that_may_be_confused_is_refused(tmp_path, names, said):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(CaptureError, match=re.escape(said)):
        open_footage(tmp_path)


def test_three_cameras_are_too_few_for_silhouettes(studio, tmp_path, capsys):
    folder = shutil.copytree(studio[0], tmp_path / "take")
    edit_description(folder, lambda content: content.update(cameras=content["cameras"][:3]))
    assert main(["calibrate", str(folder), str(tmp_path / "out"), "--silhouettes"]) == 2
    assert "expected 4 cameras or more" in capsys.readouterr().err


# How strongly cameras are held is chosen by what the refinement has not seen.


@pytest.fixture(scope="module")
def frames():
    capture = Studio(StudioConfig(seed=10002, cameras=6, frames=3, size_px=128))
    return [capture.read(time) for time in range(3)]


@pytest.mark.parametrize("best", HOLDS)
def test_of_several_times_those_left_out_choose(frames, best, monkeypatch):
    asked = []

    def missed(frames, left, bounds, hold):
        asked.append((left, hold))
        return 0.1 if hold == best else 0.2

    monkeypatch.setattr(cross_validation, "held_out_residual_px", missed)
    assert best_hold(frames, None) == best
    assert sorted(asked) == sorted((time, hold) for time in (0, 1) for hold in HOLDS)


@pytest.mark.parametrize("best", HOLDS)
def test_of_a_single_time_cameras_choose(frames, best, monkeypatch):
    judged = lambda frames, name, bounds, hold: HeldOutIou(name, 0.9, 0.95 if hold == best else 0.94)  # noqa: E731
    monkeypatch.setattr(cross_validation, "validate_without", judged)
    assert best_hold(frames[:1], None) == best


def test_the_time_that_is_left_out_is_not_refined_by(frames, monkeypatch):
    seen = []

    def refined(frames, bounds, hold):
        seen.extend(frame.time for frame in frames)
        return Refinement(frames[0].cameras, 0.0, 0.0)

    monkeypatch.setattr(cross_validation, "refine_all", refined)
    exact = held_out_residual_px(frames[:2], 1, None, HOLDS[0])
    assert seen == [0] and exact < 0.3

    def disturbed(frames, bounds, hold):
        pose = frames[0].cameras.camera_from_world.clone()
        pose[1, 1, 3] += 0.1
        return Refinement(replace(frames[0].cameras, camera_from_world=pose), 0.0, 0.0)

    monkeypatch.setattr(cross_validation, "refine_all", disturbed)
    assert held_out_residual_px(frames[:2], 1, None, HOLDS[0]) > exact + 0.3 and np.isfinite(exact)
