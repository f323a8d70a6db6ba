"""Small synthetic scenes, and cells with given scores."""

from dataclasses import fields

import pytest
from reference.computed_once import compute_once

from viewmend.evaluation.provenance import Provenance
from viewmend.evaluation.result_cache import Cell, CellKey
from viewmend.evaluation.scores import ViewScores
from viewmend.scenes.studio_scenes import StudioScene
from viewmend.studio.stage import StudioConfig

ORIGIN_PX = ("sources_px", "others_px", "past_px", "only_past_px")
ORIGIN = Provenance("0", "abc", "3", "2", "cpu", 1, 1, 0.0)


@pytest.fixture(autouse=True)
def _computed_once(monkeypatch):
    """Checks of a capture and people of the studio are computed once, not in each test."""
    compute_once(monkeypatch)


@pytest.fixture(scope="session")
def small_scenes() -> list[StudioScene]:
    """Three scenes of two sets, with two frames each."""
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
    """Makes a cell from a scene, a method, a set, frames of `make_frame`, an error, and milliseconds per frame."""

    def make(
        scene: str,
        method: str,
        name: str,
        frames: list[ViewScores],
        error: str | None = None,
        step_ms: list[float] | None = None,
    ) -> Cell:
        key = CellKey(scene, method, f"{scene}-{method}", scene)
        taken = step_ms or [1.0] * len(frames)
        return Cell(key, name, "ring", "calm", method, tuple(frames), tuple(taken), error, ORIGIN)

    return make


@pytest.fixture
def make_frame():
    """Makes a frame of 20 x 10 pixels with these scores; the others are None."""

    def make(**scores: float | None) -> ViewScores:
        pixels = {"time": 0, "width_px": 20, "height_px": 10, "hull_px": 100, "hole_px": 60, "hole_fg_px": 60}
        values = dict.fromkeys(f.name for f in fields(ViewScores)) | pixels | dict.fromkeys(ORIGIN_PX, 0)
        values |= {"psnr_whole": 30.0, "psnr_whole_rendered": 20.0}
        return ViewScores(**(values | scores))

    return make
