"""The training loop: batches, steps, averaged weights, logs, checkpoints."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel as Ddp
from torch.optim.swa_utils import AveragedModel

from viewmend.atomic_writes import write_atomically
from viewmend.inpainting.chain import Chain, build
from viewmend.inpainting.checkpoint import save_inpainter
from viewmend.inpainting.network import set_compute_dtype
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.protocol import shown_upon
from viewmend.output_folder import OutputFolder
from viewmend.training.adversary import Adversary
from viewmend.training.autoencoder import AutoencoderObjective
from viewmend.training.copies import CopyingObjective
from viewmend.training.from_tokens import TokensObjective
from viewmend.training.logs import Log, LossTerms, Progress
from viewmend.training.model_card import model_card
from viewmend.training.objective import Objective, StepOutput
from viewmend.training.plan import TAUGHT, Recipe
from viewmend.training.processes import Processes, processes
from viewmend.training.ray_batches import RaysObjective
from viewmend.training.replay import ReplayPosition, SampleReplay
from viewmend.training.run_files import FILE, PREVIOUS, RunState, last_checkpoint, load_run, save_run
from viewmend.training.sample_files import Trained, sample_to_bytes
from viewmend.training.schedule import Schedule, averaging, learning_rate_factor
from viewmend.training.sources import training_source
from viewmend.training.validation import Validation

NETWORKS = (Chain, PatchTransformer)
MADE = ("model.safetensors", "config.json", "README.md", "log.jsonl", "validation-*.png", "not-finite-*", "tensorboard")
"""What a run writes besides itself, and another may have lying there."""
OBJECTIVES: dict[str, Callable[..., nn.Module]] = {
    "rays": RaysObjective,
    "autoencoder": AutoencoderObjective,
    "copies": CopyingObjective,
    "tokens": TokensObjective,
}
"""What teaches parts otherwise than by the paper's objective."""


def train(
    recipe: Recipe,
    out: Path,
    start: nn.Module | None = None,
    report: Callable[[Progress], None] | None = None,
    kind: "type[Run] | None" = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Path:
    """Run a recipe, or go on with the run that `out` holds; under torchrun, with all of its processes.

    In `out`: the averaged weights (model.safetensors, config.json, README.md), run.safetensors to go on from,
    log.jsonl, and pictures of the validation. A run that goes on makes the very steps that it would have made.

    Args:
        recipe: what to do.
        out: folder for all that is written.
        start: a model to begin with: its weights, wherever the recipe's model has one of the same name and shape.
        report: told of each step, in the first process.
        kind: what runs; a subclass trains something else than our model.
        stopped: asked after each step in every process; once it is true anywhere, the run ends with a checkpoint.

    Raises:
        RunError: `out` holds a run of another recipe, or a damaged one.
        ValueError: another run writes there, or files lie there that no run made, and no run to go on with.
        FloatingPointError: a loss is not finite, and the batch is saved in `out`; or a weight is not, and the last
            checkpoint stays.
    """
    with processes() as own, _claimed(out) if own.first else nullcontext():
        run = (kind or Run)(recipe, out, start, own)
        for progress in run.steps(stopped):
            if report is not None and own.first:
                report(progress)
    return out


@contextmanager
def _claimed(out: Path) -> Iterator[None]:
    """The folder of a run, for this one alone.

    Raises:
        ValueError: another run writes there, or somebody else's files lie there and no run to go on with.
    """
    with OutputFolder(out) as folder:
        if last_checkpoint(out) is None:
            folder.demand_own(*MADE)
        folder.made(FILE, PREVIOUS, *MADE, *(f"{pattern}/*" for pattern in MADE[-2:]), changing=True)
        yield


class Run:
    """A run in this process: model, averages, optimizers and streams of samples.

    Subclasses that train another network override the methods from `_make_model` on.
    """

    def __init__(self, recipe: Recipe, out: Path, start: nn.Module | None, own: Processes) -> None:
        out.mkdir(parents=True, exist_ok=True)
        torch.manual_seed(recipe.seed)
        self.recipe, self.out, self.own = recipe, out, own
        self.model = self._make_model(start).to(own.device)
        self.objective = self._make_objective(start).to(own.device)
        self.average = AveragedModel(self.model, multi_avg_fn=averaging(recipe.ema))
        self.learned = [p for p in self.model.parameters() if p.requires_grad]
        self.optimizer = self._make_optimizer()
        self.adversary = None
        if recipe.loss.adversarial:
            self.adversary = Adversary(recipe.loss, recipe.discriminator_rate, own, shown_upon(self.model))
        self.state = RunState(0, 0.0, ())
        self._modules: dict[str, nn.Module] = {"model": self.model, "average": self.average}
        self._optimizers: dict[str, torch.optim.Optimizer] = {"optimizer": self.optimizer}
        if self.adversary is not None:
            self._modules["discriminator"] = self.adversary.discriminator
            self._optimizers["discriminator_optimizer"] = self.adversary.optimizer
        if last := last_checkpoint(out):
            self.state = load_run(last, recipe, self._modules, self._optimizers)
        self.shared = own.wrap_ddp(self.objective)
        self.streams = self._streams()
        self.validation = self._make_validation() if recipe.validate_every and own.first else None

    def steps(self, stopped: Callable[[], bool] = lambda: False) -> Iterator[Progress]:
        """Make all steps that are left, or those until `stopped`; yields after each."""
        schedule = Schedule(self.recipe, self.state.elapsed_s)
        with Log(self.out, self.state.step, self.own.first) as log:
            step = begun = self.state.step
            while True:
                at = self.own.furthest(1.0 if stopped() else schedule.progress(step))
                if at >= 1:
                    break
                schedule.wait()
                batches = [stream.batch(step, self.recipe.batch) for stream in self.streams]
                schedule.got()
                rate = self.recipe.learning_rate * self._rate_factor(step, at)
                for group in self.optimizer.param_groups:
                    group["lr"] = rate
                if isinstance(self.objective, Objective):
                    self.objective.progress = at
                losses = self._step(step, batches)
                step += 1
                pace = schedule.made(step, sum(map(len, batches)) * self.own.count)
                progress = Progress(step, at, rate, losses, schedule.elapsed_s(), pace)
                log.add(progress)
                if step % self.recipe.checkpoint_every == 0:
                    self._save(step, schedule)
                if self.validation is not None and step % self.recipe.validate_every == 0:
                    log.validated(self.validation.judge(self.averaged, step))
                yield progress
            if step > self.state.step:
                self._save(step, schedule)
            elif self.own.first:
                self._write_model()  # which may be lost or damaged, where nothing else is to do
            if self.validation is not None and step > begun and step % self.recipe.validate_every:
                log.validated(self.validation.judge(self.averaged, step))

    @property
    def averaged(self) -> nn.Module:
        """The averaged weights, which are the result."""
        return self.average.module

    def _make_model(self, start: nn.Module | None) -> nn.Module:
        assert start is None or isinstance(start, NETWORKS)
        return _model(self.recipe, start)

    def _make_objective(self, start: nn.Module | None) -> nn.Module:
        """A module whose call on a batch of samples is an `StepOutput`."""
        assert isinstance(self.model, NETWORKS)
        return OBJECTIVES.get(self.recipe.part, Objective)(self.model, self.recipe)

    def _make_optimizer(self) -> torch.optim.Optimizer:
        recipe = self.recipe
        return torch.optim.AdamW(self.learned, lr=recipe.learning_rate, weight_decay=recipe.weight_decay)

    def _make_validation(self) -> Validation | None:
        return Validation(self.recipe, self.out)

    def _rate_factor(self, step: int, progress: float) -> float:
        return learning_rate_factor(step, progress, self.recipe.warmup)

    def _judge(self, adversary: Adversary, batch: list[Any], output: StepOutput, weight: float):
        """See `Adversary.judge`."""
        return adversary.judge(batch, output.completed, weight)

    def _write_model(self) -> None:
        assert isinstance(self.averaged, NETWORKS)
        save_inpainter(self.averaged, self.out, model_card(self.recipe, self.state))

    def _step(self, step: int, batches: list[list[Trained]]) -> LossTerms:
        """One step of all weights, with the mean of the streams' gradients."""
        self.optimizer.zero_grad(set_to_none=True)
        losses = []
        for number, batch in enumerate(batches):
            batch = [sample.to(self.own.device) for sample in batch]
            # Each stream draws from its own seed at each step: who computes it does not matter.
            stream = number * self.own.count + self.own.rank
            torch.manual_seed((self.recipe.seed * 1_000_003 + step) * 1_009 + stream)
            last = number + 1 == len(batches)
            # Gradients but the last add up here, and meet those of other processes in its backward pass.
            with self.shared.no_sync() if isinstance(self.shared, Ddp) and not last else nullcontext():
                output = self.shared(batch)
                assert isinstance(output, StepOutput)
                total, adversarial, judged = output.total, 0.0, 0.0
                if self.adversary is not None:
                    term, judged = self._judge(self.adversary, batch, output, 1 / len(batches))
                    total, adversarial = total + self.recipe.loss.adversarial * term, float(term.detach())
                self._demand_finite(total.detach(), step, batch)
                (total / len(batches)).backward()
            image = output.image
            terms = [float(term.detach()) for term in (image.inside, image.outside, total)]
            losses.append([*terms, adversarial, judged])
        torch.nn.utils.clip_grad_norm_(self.learned, self.recipe.max_grad_norm)
        self.optimizer.step()
        self.average.update_parameters(self.model)
        if self.adversary is not None:
            self.adversary.step()
        return LossTerms(*self.own.mean(torch.tensor(losses, device=self.own.device).mean(0)).tolist())

    def _demand_finite(self, total: torch.Tensor, step: int, batch: list[Trained]) -> None:
        if torch.isfinite(total):
            return
        folder = self.out / f"not-finite-{step:06d}"
        folder.mkdir(exist_ok=True)
        for number, sample in enumerate(batch):
            data = sample_to_bytes(sample)
            write_atomically(folder / f"{number:02d}.safetensors", lambda path, data=data: path.write_bytes(data))
        raise FloatingPointError(
            f"expected a finite loss, got {float(total)} at step {step}; its batch is in {folder}: look at it, or "
            "lower the learning rate and begin with the last checkpoint"
        )

    def _streams(self) -> list[SampleReplay[Trained]]:
        """This process's streams: numbers rank, rank + count and so on."""
        recipe, own = self.recipe, self.own
        count = max(recipe.streams, own.count)
        if count % own.count:
            raise ValueError(
                f"expected as many streams for each process, got {count} for {own.count}; change either number"
            )
        if self.state.positions and len(self.state.positions) != count:
            raise ValueError(
                f"expected the {len(self.state.positions)} streams that the run began with, got {count}; start as many "
                "processes as then"
            )
        streams = []
        for number in range(own.rank, count, own.count):
            seed = f"{recipe.seed}/{number}"
            at: ReplayPosition | None = self.state.positions[number] if self.state.positions else None
            source = training_source(recipe, seed)
            streams.append(SampleReplay(source, seed, recipe.new_per_batch, recipe.replay_size, recipe.workers, at))
        return streams

    def _save(self, step: int, schedule: Schedule) -> None:
        positions = self.own.gather([stream.position for stream in self.streams])
        self.state = RunState(step, schedule.elapsed_s(), positions)
        if self.own.first:
            save_run(self.out, self.recipe, self.state, self._modules, self._optimizers)
            self._write_model()


def _model(recipe: Recipe, start: Chain | PatchTransformer | None) -> Chain | PatchTransformer:
    """The recipe's model with those weights of `start` whose name and shape it has; its part is ready to learn."""
    model = build(recipe.model).train()
    if start is not None:
        fitting = fitting_weights(model, start, recipe.anew)
        if not fitting:
            raise ValueError(
                f"expected a model to begin with of which anything fits {recipe.name}, got none that does: its sizes "
                "are others; begin without, or choose another recipe"
            )
        model.load_state_dict(model.state_dict() | fitting)
    for name, parameter in model.named_parameters():
        of_part = recipe.part == "all" or name.startswith("coarse.") == (recipe.part == "rays")
        parameter.requires_grad_(_module(name) in TAUGHT.get(recipe.part, (_module(name),)) and of_part)
    set_compute_dtype(model, torch.bfloat16 if recipe.bfloat16 else torch.float32)
    return model


def _module(weight: str) -> str:
    """Which part of a `PatchTransformer`, with or without a coarse fill before it, a weight is of."""
    return weight.removeprefix("patches.").split(".")[0]


def fitting_weights(model: nn.Module, start: nn.Module, anew: Sequence[str] = ()) -> dict[str, torch.Tensor]:
    """The weights of `start` whose name and shape `model` has, with or without a coarse fill before the patches.

    Those of the modules `anew` are not among them.
    """
    own, theirs = model.state_dict(), start.state_dict()
    inner = {name.removeprefix("patches."): weight for name, weight in theirs.items()}
    found = {f"patches.{name}": weight for name, weight in theirs.items()} | inner | theirs
    return {n: w for n, w in found.items() if n in own and own[n].shape == w.shape and _module(n) not in anew}
