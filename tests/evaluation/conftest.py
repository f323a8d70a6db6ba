"""Small scenes of the studio, and cells without any."""

from dataclasses import fields

import pytest

from viewmend.evaluation.cells import Cell, CellKey
from viewmend.evaluation.frame_scores import FrameScores
from viewmend.evaluation.provenance import Provenance
from viewmend.leave_one_out.studio_scenes import StudioScene
from viewmend.studio.stage import StudioConfig

ORIGIN = Provenance("0", "abc", "3", "2", "cpu", 1, 1, 0.0)


@pytest.fixture(scope="session")
def small_scenes() -> list[StudioScene]:
    """Three of two sets, each of two frames."""
    return [
        StudioScene(
            name=f"s{seed}",
            set="A" if seed < 3 else "B",
            rig="ring of 5",
            style="calm",
            config=StudioConfig(seed=seed, cameras=5, frames=2, size_px=96),
            held="cam02",
            tempo="calm",
        )
        for seed in (1, 2, 3)
    ]


@pytest.fixture
def make_cell():
    """Makes cells of scene, method, set, frames (`make_frame`) and error."""

    def make(scene: str, method: str, name: str, frames: list[FrameScores], error: str | None = None) -> Cell:
        key = CellKey(scene, method, f"{scene}-{method}", scene)
        return Cell(key, name, "ring", "calm", method, tuple(frames), error, ORIGIN)

    return make


@pytest.fixture
def make_frame():
    """Makes frames of 20 x 10 pixels with these scores, all others None."""

    def make(**scores: float | None) -> FrameScores:
        plain = {
            "time": 0,
            "width_px": 20,
            "height_px": 10,
            "hull_px": 100,
            "hole_px": 60,
            "hole_fg_px": 60,
            "past_px": 0,
        }
        values = dict.fromkeys(f.name for f in fields(FrameScores)) | plain | {"psnr_whole": 30.0, "step_ms": 1.0}
        return FrameScores(**(values | scores))  # pyright: ignore[reportArgumentType]

    return make
