"""Samples per second of the data side and of the optimiser: python benchmarks/training.py [--device cuda] [--write]."""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from measure import synchronise, write

from viewmend.training.loop import Run
from viewmend.training.plan import DataPlan, Recipe
from viewmend.training.processes import Processes
from viewmend.training.recipes import RECIPES
from viewmend.training.sample_files import write_shards
from viewmend.training.sources import training_source

NAMES = ("small_rays", "small", "base")


def generator(recipe: Recipe, scenes: int) -> dict[str, float]:
    """One process that makes samples, after one scene that does not count."""
    source = training_source(recipe, "benchmark")
    source.scene(0)
    samples, start = 0, time.perf_counter()
    for number in range(1, scenes + 1):
        samples += len(source.scene(number))
    synchronise(recipe.data.device)
    return {"samples": samples, "samples_per_s": round(samples / (time.perf_counter() - start), 2)}


def optimiser(recipe: Recipe, steps: int, device: str) -> dict[str, float]:
    """Steps on samples that are there, after two that do not count."""
    with TemporaryDirectory() as folder:
        shards = Path(folder) / "shards"
        source, samples = training_source(recipe, "benchmark"), []
        while len(samples) < recipe.batch:
            samples += source.scene(100 + len(samples))
        list(write_shards(samples[: recipe.batch], shards))
        data = replace(recipe.data, shards=shards)
        used = replace(recipe, data=data, steps=steps + 2, minutes=None, new_per_batch=1, replay_size=recipe.batch)
        used = replace(used, workers=0, validate_every=0, checkpoint_every=10**6)
        taken = []
        run = Run(used, Path(folder) / "run", None, Processes(0, 1, torch.device(device)))
        for _ in range(recipe.batch):  # fills the buffer
            run.streams[0].batch(0, 1)
        start = time.perf_counter()
        for _ in run.steps():
            synchronise(device)
            taken.append(time.perf_counter() - start)
            start = time.perf_counter()
    middle = sorted(taken[2:])[len(taken[2:]) // 2]
    return {"batch": recipe.batch, "samples_per_s": round(recipe.batch / middle, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--recipes", nargs="+", default=NAMES[:2])
    parser.add_argument("--scenes", type=int, default=6)
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--write", action="store_true", help="write the file in benchmarks/results")
    options = parser.parse_args()
    figures = {}
    for name in options.recipes:
        recipe = RECIPES[name](DataPlan(data_device=options.device, sizes_px=(320,)))
        made, used = generator(recipe, options.scenes), optimiser(recipe, options.steps, options.device)
        figures[name] = {"generator": made, "optimiser": used}
    print(json.dumps(figures, indent=2))
    if options.write:
        print(write("training", options.device, vars(options), figures))


if __name__ == "__main__":
    main()
