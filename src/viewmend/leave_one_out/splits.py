"""Who is kept for validation and for tests: the one guard against training on what is measured."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

Split = Literal["training", "validation", "test"]

PROCEDURAL_SEEDS: Mapping[Split, range] = {
    "training": range(9000),
    "validation": range(9000, 10000),
    "test": range(10000, 2**31),
}
"""Seeds of the studio's scenes and procedural people. No seed is in two splits."""
TEST_FOLDER = "test"
"""Characters, motions and captures in a folder of this name are kept for tests."""


def recordings(split: Split, places: Sequence[Path]) -> tuple[Path, ...]:
    """Folders or files of characters, motions or captures, as this split may use them.

    Validation is given none: whatever a model may have learned by heart, its scores are of procedural people that are
    new to it. What a model gains on recordings is measured on such that were put aside: `viewmend evaluate`.

    Raises:
        ValueError: training or validation would look at what is kept for tests.
    """
    kept = [place for place in places if TEST_FOLDER in (place.resolve().name, place.resolve().parent.name)]
    if kept and split != "test":
        raise ValueError(
            f"{kept[0]}: expected people, motions and captures that are not kept for tests, got a folder named "
            f"'{TEST_FOLDER}'; give the one for training"
        )
    return () if split == "validation" else tuple(places)
