"""Where a run's scenes come from, by its plan."""

from viewmend.training.capture_scenes import CaptureScenes, MixedScenes, open_captures
from viewmend.training.plan import DataPlan, Recipe
from viewmend.training.ray_batches import RayBatch, RayBatchScenes
from viewmend.training.sample_files import ShardScenes
from viewmend.training.samples import Sample
from viewmend.training.scenes import FIRST_TEST_SEED, FIRST_VALIDATION_SEED, SceneSource, StudioScenes


def training_source(recipe: Recipe, seed: str) -> SceneSource[Sample | RayBatch]:
    """A stream's scenes, as the recipe's part needs them.

    Raises:
        CaptureError, ShardError: what its plan names cannot be used.
    """
    if recipe.part != "rays":
        return scene_source(recipe.data, seed)
    shards = recipe.data.shards
    scenes = scene_source(recipe.data, seed) if shards is None else ShardScenes(shards, seed, (Sample, RayBatch))
    return RayBatchScenes(scenes, seed, recipe.pixels)


def scene_source(plan: DataPlan, seed: str, validation: bool = False) -> SceneSource[Sample]:
    """Shards where they are given; else captures and the studio, as the plan shares them out.

    validation: scenes of the seeds that are kept for it, whatever shards there are.

    Raises:
        CaptureError, ShardError: what the plan names cannot be used.
    """
    if plan.shards is not None and not validation:
        return ShardScenes(plan.shards, seed, (Sample,), plan.clip)
    seeds = range(FIRST_VALIDATION_SEED, FIRST_TEST_SEED) if validation else range(FIRST_VALIDATION_SEED)
    studio = StudioScenes(plan, seed, seeds)
    if not plan.captures:
        return studio
    real = CaptureScenes(open_captures(plan.captures), plan, seed)
    return MixedScenes(real, studio, plan.captures_share, seed)
