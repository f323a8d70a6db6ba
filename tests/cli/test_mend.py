"""`viewmend mend` from end to end on a small capture of a ball."""

import json
import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
from cli.conftest import rig
from live.live_servers import wait_until
from reference import tells_all
from reference.ball import AwayBall, camera_at

from viewmend.cli import main, mend, serve
from viewmend.cli.mend_output import depth_image_m
from viewmend.data.images import write_depth
from viewmend.data.native_writer import write_capture
from viewmend.data.prepare import PreparedCapture, open_masked, prepare
from viewmend.fused_geometry import fuse_geometry
from viewmend.geometry.fusion import FusionConfig
from viewmend.live.renderer import Renderer, RenderRequest
from viewmend.mending import Mender
from viewmend.metrics.image_quality import psnr, ssim_map
from viewmend.models.classical import Telea
from viewmend.stream import RenderQuality
from viewmend.types import CompletedView, IncompleteView
from viewmend.utils.contact_sheet import picture

KEYS = [
    "frames", "scored_frames", "protocol", "background", "hole_fraction", "completed_fraction",
    "psnr_whole", "psnr_whole_rendered", "ssim_whole", "lpips_whole", "lpips_whole_rendered",
    "lpips_subject", "psnr_subject", "alpha_iou", "psnr_valid", "psnr_holes", "psnr_holes_telea",
    "psnr_holes_fg", "psnr_holes_fg_telea", "hull_iou", "stage_ms",
]  # fmt: skip


TELLS_ALL = f"{tells_all.__file__}:TellsAll"


def test_a_camera_left_out_is_rendered_and_scored(folder, tmp_path, mend):
    code, report, _ = mend(folder, tmp_path / "out", "--leave-out", "held")
    assert code == 0 and list(report) == KEYS
    assert report["frames"] == report["scored_frames"] == 2
    assert report["psnr_valid"] > 19 and report["psnr_whole"] > 21  # the hull of six views is fat
    assert report["psnr_holes"] == report["psnr_holes_telea"]
    assert list(report["hull_iou"]) == ["c0", "c1", "c2", "c3", "c4", "c5", "held"]
    assert min(report["hull_iou"].values()) > 0.9
    assert set(report["stage_ms"]) == {"geometry", "context", "rendering", "inpainting"}
    holes = np.stack([cv2.imread(str(f), 0) for f in sorted((tmp_path / "out" / "holes").iterdir())])
    assert holes.shape == (2, 48, 48) and set(np.unique(holes)) <= {0, 255}
    assert report["hole_fraction"] == pytest.approx((holes > 0).sum() / 2 / 900, rel=0.3)
    assert {f.name for f in (tmp_path / "out").iterdir()} == {
        ".viewmend", "completed.mp4", "compared.mp4", "holes", "rendered", "true", "contact_sheet.png",
    }  # fmt: skip
    sheet = cv2.imread(str(tmp_path / "out" / "contact_sheet.png"))
    assert sheet.shape[1] > 8 * 260 and sheet.std() > 20
    assert [f.name for f in tmp_path.iterdir()] == ["out"]


def test_frames_that_the_model_does_not_need_leave_the_memory(folder, tmp_path, mend, monkeypatch):
    kept = []

    class Watched(Mender):
        def mend(self, *given):
            step = super().mend(*given)
            kept.append(self.stream.times)
            return step

    monkeypatch.setattr("viewmend.mending.Mender", Watched)
    monkeypatch.setattr("viewmend.cli.mend.KEPT_MB", 0.0)
    mend(folder, tmp_path / "out", "--leave-out", "held")
    assert kept == [(0,), (1,)]


def test_the_protocol_says_what_is_known_of_the_camera_left_out(folder, tmp_path, mend, capsys):
    reports = {}
    for protocol in ("strict", "target-mask", "hull-with-target-mask"):
        options = ("--leave-out", "held", "--frames", "0:1", "--protocol", protocol)
        code, reports[protocol], _ = mend(folder, tmp_path / protocol, *options)
        assert code == 0 and reports[protocol]["protocol"] == protocol
    strict, given, carved = reports.values()
    assert min(given["psnr_whole"], carved["psnr_whole"]) > strict["psnr_whole"] + 1
    assert given["hole_fraction"] == strict["hole_fraction"] and given["alpha_iou"] > 0.99
    assert given["hull_iou"]["held"] == strict["hull_iou"]["held"] < carved["hull_iou"]["held"]


def test_the_whole_subject_may_be_mended(folder, tmp_path, mend):
    given = ["--leave-out", "held", "--model", TELLS_ALL]
    _, unseen, _ = mend(folder, tmp_path / "a", *given)
    _, whole, _ = mend(folder, tmp_path / "b", *given, "--error-rule", "all")
    assert unseen["psnr_whole"] != pytest.approx(whole["psnr_whole"], abs=0.5)
    assert unseen["completed_fraction"] == unseen["hole_fraction"] == whole["hole_fraction"] < 0.5
    assert whole["completed_fraction"] == 1
    same = ["psnr_whole_rendered", "psnr_holes_telea", "psnr_holes", "alpha_iou"]
    assert {key: whole[key] for key in same} == pytest.approx({key: unseen[key] for key in same}, abs=1e-4)
    assert whole["psnr_valid"] < unseen["psnr_valid"]
    asked = [cv2.imread(str(tmp_path / out / "holes" / "000000.png"), 0) > 0 for out in "ab"]
    assert asked[1][asked[0]].all() and asked[1].sum() > 2 * asked[0].sum()


def test_the_whole_view_is_scored(folder, tmp_path, mend):
    _, report, _ = mend(folder, tmp_path / "out", "--leave-out", "held", "--frames", "1:2")
    prepared = prepare(open_masked(folder), [f"c{n}" for n in range(6)])
    truth = prepared.read(1).select(["held"])
    image, mask = truth.rgb[0] / 255 * (truth.mask[0] / 255), truth.mask[0] > 127
    seen = torch.from_numpy(
        cv2.imread(str(tmp_path / "out" / "completed" / "000000.png"))[..., ::-1] / 255
    ).movedim(-1, 0)
    assert report["psnr_whole"] == pytest.approx(psnr(seen, image), abs=0.02)
    assert report["psnr_subject"] == pytest.approx(psnr(seen, image, mask), abs=0.02)
    assert report["ssim_whole"] == pytest.approx(float(ssim_map(seen, image).nanmean()), abs=1e-3)
    assert report["alpha_iou"] == pytest.approx(report["hull_iou"]["held"], abs=1e-9)
    assert report["psnr_whole_rendered"] < report["psnr_whole"]


def pictures(folder, flags=cv2.IMREAD_COLOR_RGB):
    return np.stack([cv2.imread(str(file), flags) for file in sorted(folder.iterdir())])


def test_rendered_views_and_the_truth_lie_beside_the_mended_ones(folder, tmp_path, mend):
    mend(folder, tmp_path, "--leave-out", "held", "--frames", "1:2")
    rendered, mended, truth = (pictures(tmp_path / name)[0] for name in ("rendered", "completed", "true"))
    holes = pictures(tmp_path / "holes", 0)[0] > 0
    assert (rendered[holes] == 0).all() and (mended[holes] > 0).any() and (rendered == mended)[~holes].all()
    true = prepare(open_masked(folder), [f"c{n}" for n in range(6)]).read(1).select(["held"])
    assert np.abs(truth - picture(true.rgb[0] / 255 * (true.mask[0] / 255)).astype(int)).max() <= 1
    mend(folder, tmp_path, "--path", "orbit:seconds=0.2")  # without ground truth
    assert not (tmp_path / "true").exists() and (tmp_path / "compared.mp4").exists()


def test_frames_in_which_the_camera_left_out_is_absent_have_no_true_view(folder, tmp_path, mend):
    source = shutil.copytree(folder, tmp_path / "gap")
    (first, *_) = sorted((source / "image" / "held").iterdir())
    first.unlink()
    code, report, said = mend(source, tmp_path / "out", "--leave-out", "held", "--frames", "0:2")
    assert code == 0 and report["frames"] == 2 and report["scored_frames"] == 1
    assert "1 of 2 views have no usable image of 'held': they are made without its mask" in said
    assert [file.name for file in (tmp_path / "out/true").iterdir()] == ["000001.png"]
    with av.open(str(tmp_path / "out/compared.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == 2


def test_a_frame_with_one_usable_camera_is_skipped(folder, tmp_path, mend, monkeypatch):
    read = PreparedCapture.read

    def read_some(capture, time):
        frame = read(capture, time)
        return frame.select(("c0", *frame.cameras.names[6:])) if time in unusable else frame

    monkeypatch.setattr(PreparedCapture, "read", read_some)
    inputs = ("--no-align", "--frames", "0:2", "--cameras", *rig().names[:6])
    unusable = {1}
    for target in (("--leave-out", "held"), ("--path", "orbit:seconds=0.2")):
        code, report, said = mend(folder, tmp_path / target[0], *target, *inputs)
        assert code == 0 and report["frames"] < 4
        assert "1 of 2 frames have fewer than two usable input cameras and were skipped" in said
    unusable = {0, 1}
    for target in (("--leave-out", "held"), ("--path", "orbit:seconds=0.2")):
        code, _, said = mend(folder, tmp_path / "none", *target, *inputs)
        assert code == 2 and "expected a frame with two usable input cameras, got none" in said
        assert not (tmp_path / "none/rendered").exists()


def test_the_subject_is_cut_out_without_dark_fringes(folder, tmp_path, mend):
    mend(folder, tmp_path, "--leave-out", "held", "--model", TELLS_ALL, "--error-rule", "all", "--alpha")
    cut = pictures(tmp_path / "cutout", cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]].astype(int)
    alpha = cut[..., 3:]
    assert cut.shape == (2, 48, 48, 4) and (alpha == 0).any() and ((alpha > 20) & (alpha < 200)).any()
    assert np.abs(cut[(alpha > 0)[..., 0]][:, :3] - np.array(tells_all.COLOUR) * 255).max() < 10
    with av.open(str(tmp_path / "cutout.webm")) as film:
        decoder = av.CodecContext.create("libvpx-vp9", "r")
        frames = [
            f.to_ndarray(format="rgba") for p in film.demux(film.streams.video[0]) for f in decoder.decode(p)
        ]
    assert len(frames) == 2 and np.abs(frames[1][..., 3] - cut[1, ..., 3]).mean() < 4


def test_depth_is_written_in_millimetres(folder, tmp_path, mend):
    given = ["--leave-out", "held", "--depth", "--frames", "1:2"]
    for out, model in (("proxy", "telea"), ("own", TELLS_ALL)):
        mend(folder, tmp_path / out, *given, "--model", model)
    proxy, own = (
        pictures(tmp_path / out / "depth", cv2.IMREAD_UNCHANGED)[0].astype(int) for out in ("proxy", "own")
    )
    assert proxy.dtype == int and 1000 < proxy.max() < 9000 and proxy[0, 0] == own[0, 0] == 0
    assert np.abs(proxy - own - 100)[proxy > 0].max() <= 1  # what the model tells, a hand nearer


def test_depth_beyond_what_sixteen_bits_hold_is_the_largest(tmp_path):
    camera, blank = camera_at(0, "c"), torch.zeros(1, 4)
    view = IncompleteView(camera, blank.expand(3, 1, 4), blank, blank, blank, (), blank[None][:0], 0)
    told = CompletedView(view, view.rgb, depth=torch.tensor([[0.0, 2.0, 65.6, 500.0]]))
    write_depth(tmp_path / "d.png", depth_image_m(told))
    assert cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED).tolist() == [[0, 2000, 65535, 65535]]


@pytest.mark.parametrize("how", ["white", "beside"])
def test_what_the_camera_left_out_saw_changes_scores_alone(folder, tmp_path, mend, how):
    other = tmp_path / "other"
    shutil.copytree(folder, other)
    for kind, value in (("image", 200), ("mask", 255)):
        for file in (other / kind / "held").iterdir():
            picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(file), np.full_like(picture, value) if how == "white" else np.roll(picture, 6, 1))
    runs = [
        mend(given, tmp_path / out, "--leave-out", "held", "--frames", "1:2")
        for given, out in ((folder, "a"), (other, "b"))
    ]
    pictures = [cv2.imread(str(tmp_path / out / "completed" / "000000.png")) for out in "ab"]
    assert np.array_equal(*pictures) and pictures[0].std() > 20
    assert runs[0][1]["hole_fraction"] == runs[1][1]["hole_fraction"]
    assert runs[0][1]["psnr_whole"] > runs[1][1]["psnr_whole"] + (10 if how == "white" else 3)


def test_an_orbit_shows_the_whole_motion(folder, tmp_path, mend):
    path = "orbit:seconds=0.5,fps=12,size=64x40,background=white"
    code, report, _ = mend(folder, tmp_path / "out", "--path", path)
    assert code == 0 and report["frames"] == 6
    views = pictures(tmp_path / "out" / "rendered").astype(int)
    assert views.shape == (6, 40, 64, 3)
    subject = views.min(-1) < 250
    assert subject.any((1, 2)).all() and not subject[:, [0, -1]].any() and not subject[:, :, [0, -1]].any()
    rows = subject.any((0, 2)).nonzero()[0]
    assert rows[-1] - rows[0] > 30, "it fills the image"
    with av.open(str(tmp_path / "out" / "completed.mp4")) as film:
        assert film.streams.video[0].average_rate == 12
    assert report["psnr_whole"] is None and report["psnr_holes_telea"] is None
    assert report["hole_fraction"] < 0.9 and min(report["hull_iou"].values()) > 0.9


def test_poses_come_from_a_file(folder, tmp_path, mend):
    poses = [camera_at(angle, "t").world_from_camera[0].tolist() for angle in (30, 60, 80)]
    file = tmp_path / "path.json"
    K = [[60, 0, 20], [0, 60, 10], [0, 0, 1]]
    file.write_text(json.dumps({"world_from_camera": poses, "K": K, "width": 40, "height": 20}))
    code, report, _ = mend(folder, tmp_path / "out", "--path", file, "--frames", "0:1")
    assert code == 0 and report["frames"] == 3
    assert cv2.imread(str(tmp_path / "out" / "holes" / "000002.png"), 0).shape == (20, 40)


def test_a_recorded_path_plays_the_frames_it_was_recorded_with(folder, tmp_path, mend):
    poses = [camera_at(angle, "t").world_from_camera[0].tolist() for angle in (30, 60, 80, 90)]
    file = tmp_path / "path.json"
    content = {"world_from_camera": poses, "width": 40, "height": 20, "fps": 30, "times": [1, 1, 0, 1]}
    file.write_text(json.dumps(content))
    code, report, _ = mend(folder, tmp_path / "out", "--path", file, "--model", "telea")
    assert code == 0 and report["frames"] == 4
    with av.open(str(tmp_path / "out" / "completed.mp4")) as film:
        assert film.streams.video[0].average_rate == 30
    alone = tmp_path / "alone.json"
    alone.write_text(json.dumps(content | {"world_from_camera": poses[1:2], "times": [1]}))
    assert mend(folder, tmp_path / "one", "--path", alone, "--model", "telea")[0] == 0
    second = pictures(tmp_path / "out" / "rendered")[1]
    assert np.array_equal(pictures(tmp_path / "one" / "rendered")[0], second)
    assert (
        mend(folder, tmp_path / "none", "--path", file, "--frames", "0:1", "--model", "telea")[1]["frames"]
        == 4
    )


def test_the_page_shows_the_same_pixels(shifted, tmp_path, mend):
    prepared = prepare(open_masked(shifted))
    camera = prepared.cameras[0]
    file = tmp_path / "path.json"
    pose = camera.world_from_camera[0].tolist()
    file.write_text(
        json.dumps({"world_from_camera": [pose], "K": camera.K[0].tolist(), "width": 48, "height": 48})
    )
    assert mend(shifted, tmp_path / "out", "--path", file, "--frames", "0:1")[0] == 0
    source = serve.open_source(serve.Options(source=str(shifted)))
    source.start()
    try:
        wait_until(lambda: source.read(0) is not None)
        renderer = Renderer(source, Telea())
        renderer.prepare(0)
        (view,) = renderer.render(RenderRequest(0, (camera,), RenderQuality()), None).completed
    finally:
        source.stop()
    mended = cv2.imread(str(tmp_path / "out" / "completed" / "000000.png"))[..., ::-1]
    assert mended.std() > 20 and np.abs(picture(view.rgb).astype(int) - mended).max() <= 1


@pytest.fixture(scope="module")
def away(tmp_path_factory):
    """A capture of five frames, of which the first and the fourth are empty."""
    path = tmp_path_factory.mktemp("away") / "ball"
    write_capture(AwayBall(rig(), 5, {0, 3}), path, images="png")
    return path


def test_frames_without_a_subject_show_the_background_and_keep_their_time(away, tmp_path, mend):
    code, report, said = mend(away, tmp_path / "out", "--leave-out", "held", "--alpha", "--depth")
    assert code == 0 and report["frames"] == 5
    assert "2 of 5 frames have no subject ('000', '003'); they show the background" in said
    seen = [cv2.imread(str(file)).any() for file in sorted((tmp_path / "out" / "rendered").iterdir())]
    assert seen == [False, True, True, False, True]
    with av.open(str(tmp_path / "out" / "completed.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == 5
    assert 20 < report["psnr_whole"] < 30, "empty frames, of 100 dB, are not scored"


def test_an_orbit_goes_around_the_subject_while_it_is_there(away, tmp_path, mend):
    code, report, said = mend(away, tmp_path / "out", "--path", "orbit:seconds=0.5,loop=repeat")
    assert code == 0 and report["frames"] == 5 and "2 of 5 frames have no subject" in said
    code, report, said = mend(away, tmp_path / "none", "--path", "orbit:seconds=0.2", "--frames", "3:4")
    assert code == 2 and "expected a subject to circle, got none" in said
    code, report, said = mend(away, tmp_path / "one", "--leave-out", "held", "--frames", "3:4")
    assert code == 0 and report["psnr_whole"] is None and "1 of 1 frames" in said


def test_the_geometry_may_be_fused_from_predicted_depth(folder, tmp_path, mend, monkeypatch):
    small = FusionConfig(resolution=96, max_views=12, view_px=96)
    monkeypatch.setattr(
        "viewmend.stream.fuse_geometry",
        lambda *arguments: fuse_geometry(*arguments[:4], small, *arguments[5:]),
    )
    reports = {}
    for geometry in ("hull", "fused"):
        options = ("--leave-out", "held", "--frames", "0:1", "--geometry", geometry)
        code, reports[geometry], _ = mend(folder, tmp_path / geometry, *options)
        assert code == 0
    assert reports["fused"]["hull_iou"]["held"] != reports["hull"]["hull_iou"]["held"]


def test_images_are_used_at_a_fraction_of_their_size(folder, tmp_path, mend, capsys):
    options = ("--leave-out", "held", "--frames", "0:1")
    code, report, _ = mend(folder, tmp_path / "half", *options, "--scale", "0.5")
    assert code == 0 and report["psnr_whole"] > 20
    assert cv2.imread(str(tmp_path / "half/completed/000000.png")).shape == (24, 24, 3)
    assert main(["mend", str(folder), "--out", str(tmp_path / "none"), *options, "--scale", "1.5"]) == 2
    assert "expected --scale above 0 and up to 1, got 1.5" in capsys.readouterr().err


@pytest.mark.parametrize("width, advised", [(1000, None), (1024, "0.9"), (1920, "0.5"), (20000, "0.1")])
def test_the_advised_scale_makes_images_smaller(width, advised):
    options = mend.Options(capture=Path("capture"), out=Path("out"))
    advice = mend._speed_advice(options, camera_at(0, "wide").resized(width, 600))
    assert (advised is None and advice == "") or f"--scale {advised} is faster" in advice
