"""No split shares a seed with another, and none but the test's looks into the test's folders."""

from itertools import combinations
from pathlib import Path

import pytest

from viewmend.data.holdout.scenes import PROCEDURAL_SEEDS, recordings
from viewmend.data.holdout.studio_scenes import P_SEEDS, Q_SEEDS


def test_no_seed_is_in_two_splits():
    for one, other in combinations(PROCEDURAL_SEEDS.values(), 2):
        assert one.stop <= other.start or other.stop <= one.start
    assert range(10000, 10030) == P_SEEDS and Q_SEEDS.start == 20000
    assert all(seeds[0] in PROCEDURAL_SEEDS["test"] for seeds in (P_SEEDS, Q_SEEDS))


@pytest.mark.parametrize("place", ["people/test", "people/test/ann.glb", "captures/test/stage", "people/train/../test"])
def test_what_is_kept_for_tests_is_for_tests_alone(place):
    places = (Path("motions/train"), Path(place))
    assert recordings("test", places) == places
    for split in ("training", "validation"):
        with pytest.raises(
            ValueError, match="not kept for tests, got a folder named 'test'; give the one for training"
        ):
            recordings(split, places)


def test_training_is_given_the_rest():
    places = (Path("people/train"), Path("people/testers/ann.glb"), Path("latest"))
    assert recordings("training", places) == places
