"""Scenes on disk that all processes of a test run share: the first that needs one writes it, the others wait."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from filelock import FileLock
from reference.ball import BallCapture, ring

from viewmend.data.native_writer import write_capture
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.types import MultiViewFrame

TAKES = ("ada", "bea", "cleo")
"""Names of the three takes; the seed of each is its position."""


class FilmedStudio(Studio):
    """A studio whose cameras measure no depth, like those of most captures."""

    def read(self, time: int) -> MultiViewFrame:
        """All cameras at index `time`: images and masks."""
        return replace(super().read(time), depth=None)


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """The folder `name` of this test run, which `make` writes if no process has done so."""
    folder = factory.getbasetemp()
    if folder.name.startswith("popen-"):  # a worker of pytest-xdist; the folder above belongs to the run
        folder = folder.parent
    path = folder / "shared" / name
    path.parent.mkdir(exist_ok=True)
    with FileLock(path.with_suffix(".lock")):
        if not path.exists():
            unfinished = path.with_suffix(".unfinished")
            make(unfinished)
            unfinished.rename(path)
    return path


def write_takes(folder: Path) -> None:
    """Three people, each seen by five cameras of 96 x 96 pixels in four frames."""
    for seed, name in enumerate(TAKES):
        studio = FilmedStudio(StudioConfig(seed=seed, cameras=5, frames=4, size_px=96))
        write_capture(studio, folder / name)


def write_balls(folder: Path) -> None:
    """Three captures of a ball with four frames each, for tests that ask which frames and cameras are used."""
    for name in TAKES:
        write_capture(BallCapture(ring(5), 4), folder / name, images="png")
