"""Chooses the held-out cameras of the sets R48 and R34, and prints them as the file `rig_views.csv`.

    python research/choose_rig_views.py R48 --performers PEOPLE > R48.csv

For each scene, cameras are tried in an order that follows from its seed, until the view of one has enough hole pixels
inside its true mask. Scenes without such a view are left out.
"""

from collections.abc import Iterator
from pathlib import Path
from random import Random

import torch
import tyro

from viewmend.models.classical import Unfilled
from viewmend.scenes.studio_scenes import (
    RigName,
    StudioScene,
    performer_rig_scenes,
    procedural_rig_scenes,
)
from viewmend.stream import Stream
from viewmend.types import MultiViewFrame

MIN_HOLE_PX = 200
"""Fewest hole pixels inside the true mask of a view of the sets, at 512 x 512."""
MAX_TRIES = 24
"""Cameras that are tried in each scene."""


def main(
    name: tyro.conf.Positional[RigName],
    performers: Path | None = None,
    motions: Path | None = None,
    count: int = 30,
) -> None:
    """Print one line for each chosen view: scene, held-out camera, hole pixels inside the true mask.

    Args:
        name: the set.
        performers: folder of glTF people, as for `viewmend evaluate`.
        motions: folder of their motions.
        count: procedural scenes to find.
    """
    print("scene,held,hole_px")
    print_views(iter(procedural_rig_scenes(name)), count)
    if performers is not None:
        scenes = performer_rig_scenes(name, performers, motions)
        print_views(iter(scenes), len(scenes))


def print_views(scenes: Iterator[StudioScene], count: int) -> None:
    """Print the views of this many scenes that have one."""
    found = 0
    for scene in scenes:
        if found == count:
            return
        view = choose_view(scene)
        if view is not None:
            found += 1
            print(f"{scene.name},{view[0]},{view[1]}", flush=True)


def choose_view(scene: StudioScene) -> tuple[str, int] | None:
    """The first camera whose view has enough hole pixels inside the true mask, and their number; None if none has."""
    studio = scene.studio()
    names = list(studio.cameras.names)
    seen = studio.silhouettes(scene.times[-1], names)
    rgb = seen.mask.new_zeros(len(names), 3, *seen.mask.shape[1:])
    frame = MultiViewFrame(seen.cameras, rgb, seen.mask, scene.times[-1])
    for held in Random(scene.config.seed).sample(names, min(MAX_TRIES, len(names))):
        hole_px = count_holes(frame, held)
        if hole_px >= MIN_HOLE_PX:
            return held, hole_px
    return None


def count_holes(frame: MultiViewFrame, held: str) -> int:
    """Hole pixels inside the true mask of a held-out camera's view; colours are not needed."""
    stream = Stream(Unfilled())
    stream.add_frame(frame.without((held,)))
    truth = frame.select([held])
    assert truth.mask is not None, "the studio draws masks"
    view = stream.render(truth.cameras)
    return int((view.holes & (truth.mask[0] > 127)).sum())


if __name__ == "__main__":
    torch.set_num_threads(1)
    tyro.cli(main)
