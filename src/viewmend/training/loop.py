"""The training loop: batches, steps, averaged weights, logs, checkpoints."""

import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random

import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from viewmend.inpainting.checkpoint import save_inpainter
from viewmend.inpainting.inpainter import Inpainter
from viewmend.training.losses import ImageLoss, image_loss
from viewmend.training.recipes import Recipe
from viewmend.training.samples import Sample
from viewmend.training.scenes import SampleStream


@dataclass(frozen=True)
class Progress:
    """One step of a run, as the log has it."""

    step: int
    progress: float
    """Share of the run, 0 to 1."""
    inside: float
    """L_in of the batch."""
    outside: float
    """L_out of the batch."""
    elapsed_s: float


def batches(recipe: Recipe) -> Iterator[list[Sample]]:
    """Endless batches: `fresh` new samples and the rest from the buffer of the last ones."""
    random = Random(recipe.seed)
    stream = iter(SampleStream(recipe.data, recipe.seed).loader(recipe.workers))
    buffer: list[Sample] = []
    while True:
        fresh = [next(stream) for _ in range(recipe.fresh)]
        again = random.sample(buffer, min(recipe.batch - recipe.fresh, len(buffer)))
        for sample in fresh:
            if len(buffer) < recipe.buffer:
                buffer.append(sample)
            else:
                buffer[random.randrange(recipe.buffer)] = sample
        yield fresh + again


def batch_loss(model: Inpainter, batch: list[Sample]) -> ImageLoss:
    """The objective of section 8 over a batch, through encoder, context and transformer."""
    predictions = model([s.view for s in batch], [list(s.context) for s in batch], nearby=[s.nearby for s in batch])
    return image_loss(
        [p.inpainted for p in predictions],
        [p.coverage for p in predictions],
        [s.view.error for s in batch],
        [s.truth.float() / 255 for s in batch],
    )


def rays_loss(model: Inpainter, batch: list[Sample], most_px: int) -> ImageLoss:
    """The objective inside the holes, of what the ray reader makes of at most `most_px` random pixels of each view."""
    assert model.ray_reader is not None, "recipes that train rays have a model that reads them"
    pixels = [torch.nonzero(s.view.error > 0) for s in batch]
    pixels = [p[torch.randperm(len(p), device=p.device)[:most_px]] for p in pixels]
    with model.autocast():
        filled = model.ray_reader([s.view for s in batch], [s.nearby for s in batch], pixels)
    one = torch.ones((), device=filled[0].device)
    counted = [
        torch.zeros_like(s.view.error).index_put(tuple(p.unbind(1)), one) for s, p in zip(batch, pixels, strict=True)
    ]
    nowhere = [torch.zeros_like(s.view.error) for s in batch]
    return image_loss(filled, nowhere, counted, [s.truth.float() / 255 for s in batch])


def learning_rate_factor(step: int, progress: float, warmup: int) -> float:
    """Linear warm-up, then a cosine to zero as `progress` goes from 0 to 1."""
    return min((step + 1) / warmup, 1.0) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))


def train(
    recipe: Recipe, out: Path, start: Inpainter | None = None, report: Callable[[Progress], None] | None = None
) -> Path:
    """Run a recipe; the averaged weights are in `out` every 100 steps and at the end, the log in out/log.jsonl.

    start: a model to go on from: its weights, wherever the recipe's model has one of the same name and shape.
    report: told of each step.

    Raises:
        FloatingPointError: a loss is not finite.
    """
    torch.manual_seed(recipe.seed)
    out.mkdir(parents=True, exist_ok=True)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    model = _model(recipe, start).to(device)
    average = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(recipe.ema))
    averaged = average.module
    assert isinstance(averaged, Inpainter)
    learned = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(learned, lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
    began, entry = time.monotonic(), Progress(-1, 0.0, 0.0, 0.0, 0.0)
    with (out / "log.jsonl").open("a") as log:
        for step, batch in enumerate(batches(recipe)):
            elapsed_s = time.monotonic() - began
            progress = max(step / recipe.steps, elapsed_s / 60 / recipe.minutes if recipe.minutes else 0.0)
            if progress >= 1:
                break
            factor = learning_rate_factor(step, progress, recipe.warmup)
            optimizer.param_groups[0]["lr"] = recipe.learning_rate * factor
            batch = [sample.to(device) for sample in batch]
            loss = rays_loss(model, batch, recipe.pixels) if recipe.part == "rays" else batch_loss(model, batch)
            total = loss.total(recipe.log_error_weight)
            if not torch.isfinite(total):
                raise FloatingPointError(f"expected a finite loss, got {loss} at step {step}; lower the learning rate")
            optimizer.zero_grad(set_to_none=True)
            total.backward()
            torch.nn.utils.clip_grad_norm_(learned, recipe.clip)
            optimizer.step()
            average.update_parameters(model)
            entry = Progress(step, progress, loss.inside.item(), loss.outside.item(), elapsed_s)
            log.write(json.dumps(asdict(entry)) + "\n")
            log.flush()
            if report is not None:
                report(entry)
            if step % 100 == 99:
                save_inpainter(averaged, out, _card(recipe, entry))
    save_inpainter(averaged, out, _card(recipe, entry))
    return out


def _model(recipe: Recipe, start: Inpainter | None) -> Inpainter:
    """The recipe's model with those weights of `start` whose name and shape it has; its part is ready to learn."""
    model = Inpainter(recipe.model).train()
    own = model.state_dict()
    given = {} if start is None else start.state_dict()
    model.load_state_dict(own | {n: w for n, w in given.items() if n in own and own[n].shape == w.shape})
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(recipe.part == "all" or name.startswith("ray_reader.") == (recipe.part == "rays"))
    model.compute_dtype = torch.bfloat16 if recipe.bfloat16 else torch.float32
    return model


def _card(recipe: Recipe, entry: Progress) -> str:
    """The model card: what trained these weights. What they score is for the evaluation to add."""
    characters = "" if recipe.data.performers is None else f", {recipe.data.performers_share:.0%} of the scenes glTF"
    return f"""# {recipe.name}

Trained by `viewmend train {recipe.name}`: {entry.step + 1} steps of {recipe.batch} samples in
{entry.elapsed_s / 60:.0f} minutes ({entry.progress:.0%} of the schedule), seed {recipe.seed},
torch {torch.__version__}, {torch.get_num_threads()} threads, CUDA {torch.cuda.is_available()}.
Loss: L1 inside and outside of the holes (section 8), and {recipe.log_error_weight:g} x log10 of the squared error in
them; averaged weights.
Data: studio scenes made on the fly{characters}; no real captures, no test seeds, performers or motions.
"""
