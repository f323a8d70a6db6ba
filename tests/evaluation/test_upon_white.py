"""Scores upon white: the same views, laid on white; what fills by what it is shown is shown white."""

from dataclasses import replace

import torch

from viewmend.backgrounds import laid_upon
from viewmend.baselines.classical import Telea
from viewmend.evaluation.cells import cell_keys
from viewmend.evaluation.scene_run import RunSettings, evaluate_scene
from viewmend.inpainting.checkpoint import load_inpainter
from viewmend.inpainting.protocol import ContextProvider, State, own_background
from viewmend.inpainting.upon_white import UponWhite
from viewmend.stream import Stream

NOBODY = ContextProvider(lambda *_: None)


def rendered(scene):
    frame = next(scene.frames("cpu"))
    stream = Stream(Telea())
    stream.push(frame.inputs)
    return stream.render(frame.truth.cameras)


def test_what_is_filled_upon_white_is_telea_on_a_white_picture_and_known_pixels_stay(small_scenes):
    view = rendered(small_scenes[0])
    done, _ = UponWhite(Telea()).step(view, NOBODY, State())
    holes = view.error > 0
    assert holes.sum() > 50 and torch.equal(done.rgb[:, ~holes], view.rgb[:, ~holes])
    white = replace(view, rgb=torch.where(view.mask > 0, view.rgb, 1.0))
    expected = Telea().step(white, NOBODY, State())[0].rgb
    torch.testing.assert_close(laid_upon("white", done.rgb, done.opacity), expected)
    assert (expected[:, holes].mean() - Telea().step(view, NOBODY, State())[0].rgb[:, holes].mean()) > 0.02


def test_scores_tell_the_background_and_only_white_is_another_cell(small_scenes):
    scene = replace(small_scenes[0], config=replace(small_scenes[0].config, frames=1))
    black, white = (
        evaluate_scene(scene, ("telea", "unfilled"), RunSettings(background=background)).runs
        for background in ("black", "white")
    )
    for before, after in zip(black, white, strict=True):
        (one,), (other,) = before.frames, after.frames
        assert one.hole_px == other.hole_px and one.psnr_whole != other.psnr_whole
        assert one.psnr_subject != other.psnr_subject or before.method == "unfilled"
    keys = [cell_keys(scene, {"telea": "x"}, RunSettings(background=b)) for b in ("black", "white")]
    assert keys[0] == cell_keys(scene, {"telea": "x"}, RunSettings()) != keys[1]


def test_models_that_were_trained_upon_black_are_shown_black():
    assert own_background(Telea()) is None and own_background(UponWhite(Telea())) is None
    assert own_background(load_inpainter("small")) == "black" == own_background(load_inpainter("views"))
