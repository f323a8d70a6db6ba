"""Where a run's scenes come from, by its plan."""

from collections.abc import Sequence
from pathlib import Path

from viewmend.capture.plain import PlainCapture
from viewmend.capture.prepare import open_masked, prepare
from viewmend.leave_one_out.capture_splits import is_splits, training_captures
from viewmend.leave_one_out.splits import Split, recordings
from viewmend.training.capture_scenes import CaptureScenes, MixedScenes
from viewmend.training.plan import DataPlan, Recipe, WholeViewRecipe
from viewmend.training.ray_batches import RayBatch, RayBatchScenes
from viewmend.training.sample_files import ShardScenes, StoredShards, Trained
from viewmend.training.samples import Sample
from viewmend.training.scenes import SceneSource, StudioScenes
from viewmend.training.stored_scenes import StoredSamples, StoredScene, StudioStore
from viewmend.training.whole_views import WholeViewScenes, untrained
from viewmend.training.windows import WindowScenes


def training_source(recipe: Recipe, seed: str) -> SceneSource[Trained]:
    """A stream's scenes, as the recipe's part needs them.

    Raises:
        CaptureError, ShardError, WeightsError: what its plan names cannot be used.
    """
    if isinstance(recipe, WholeViewRecipe):
        samples = StoredSamples(stored_source(recipe, seed), recipe.data, seed)
        return WholeViewScenes(samples, seed, untrained(recipe))
    if recipe.part != "rays":
        return scene_source(recipe.data, seed)
    shards = recipe.data.shards
    scenes = scene_source(recipe.data, seed) if shards is None else ShardScenes(shards, seed, (Sample, RayBatch))
    return RayBatchScenes(scenes, seed, recipe.pixels_per_view)


def stored_source(recipe: Recipe, seed: str, split: Split = "training") -> SceneSource[StoredScene]:
    """Scenes of whole views, compressed: from shards where they are given, else made.

    Raises:
        ShardError: the shards cannot be used.
        ValueError: the plan names what is kept for tests.
    """
    if recipe.data.shards is not None and split == "training":
        return StoredShards(recipe.data.shards, seed)
    return StudioStore(StudioScenes(recipe.data, seed, split))


def scene_source(plan: DataPlan, seed: str, split: Split = "training") -> SceneSource[Sample]:
    """Shards where they are given; else captures and the studio, as the plan shares them out; in windows by the plan.

    Scenes for validation are the studio's with procedural people, whatever else there is.

    Raises:
        CaptureError, ShardError: what the plan names cannot be used.
        ValueError: the plan names what is kept for tests.
    """
    if plan.shards is not None and split == "training":
        return ShardScenes(plan.shards, seed, (Sample,), plan.clip_length)
    scenes = _whole_scenes(plan, seed, split)
    return WindowScenes(scenes, plan, seed) if plan.windows and split == "training" else scenes


def _whole_scenes(plan: DataPlan, seed: str, split: Split) -> SceneSource[Sample]:
    studio = StudioScenes(plan, seed, split)
    if not (folders := recordings(split, plan.captures)):
        return studio
    opened = [own for folder in folders for own in _captures(folder)]
    # Here for what is refused alone: each view prepares its inputs itself.
    captures = [prepare(capture, align=False, match_colours=False) for capture, _ in opened]
    return MixedScenes(
        CaptureScenes(captures, plan, seed, [held for _, held in opened]), studio, plan.captures_fraction, seed
    )


def _captures(place: Path) -> Sequence[tuple[PlainCapture, str | None]]:
    """A capture; or those of a file of splits that are for training, each with the camera that it leaves out."""
    return training_captures(place) if is_splits(place) else [(open_masked(place, held=1), None)]
