"""The training loop: batches, steps, averaged weights, checkpoints, and the processes that share a run."""

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel as Ddp
from torch.optim.swa_utils import AveragedModel

from viewmend.models.network import faster_dtype
from viewmend.training.config import TrainConfig
from viewmend.training.held_back import PATIENCE, HeldBackValidation, is_better
from viewmend.training.objective import NEW_VIEWS_SCORE, TRAINED_SCORE, StepOutput, Validation
from viewmend.training.replay import ReplayPosition, SampleReplay
from viewmend.training.run_files import (
    CHECKPOINT,
    PREVIOUS_CHECKPOINT,
    Log,
    Progress,
    RunState,
    last_checkpoint,
    load_run,
    model_card,
    read_validations,
    save_run,
)
from viewmend.training.shards import sample_to_bytes
from viewmend.utils.atomic_writes import write_atomically
from viewmend.utils.output_folder import OutputFolder
from viewmend.utils.tensors import to_device

WRITTEN_FILES = (
    "model.safetensors",
    "config.json",
    "README.md",
    "log.jsonl",
    "comparison.png",
    "validation-*.png",
)
"""A run writes these files, apart from its checkpoints."""
WRITTEN_FOLDERS = ("not-finite-*", "tensorboard")
"""A run writes these folders."""
LOSSES = ("inside", "outside", "total", "adversarial", "discriminator")
"""The losses of a step are logged under these names. `inside` and `outside` are the L1 loss inside and outside
the holes, `total` is the loss that is minimised, and the last two are 0 without an adversary."""


def train(
    config: TrainConfig,
    out: Path,
    start: nn.Module | None = None,
    report: Callable[[Progress], None] | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Path:
    """Train, or resume the run in `out`; under torchrun, with all of its processes.

    `out` gets the averaged weights (model.safetensors, config.json, README.md), run.safetensors to
    resume from, log.jsonl, and images of the validation. Without a time limit, a resumed run makes
    exactly the steps it would have made uninterrupted.

    Args:
        config: what to train, and how; its objective may come from outside of the package.
        out: folder for all files.
        start: the model to start from, instead of the one that `config.start` names.
        report: called after each step in the first process.
        stopped: called before each step and after the last, in every process; once any returns True,
            the run ends, with a checkpoint of the steps that it has made.

    Returns:
        `out`.

    Raises:
        RunError: `out` holds a run with another config, or a damaged one.
        ValueError: another run is writing there; `out` holds files that no run wrote; or the number of
            sample streams does not fit that of the processes, or the earlier part of the run.
        FloatingPointError: a loss is not finite (its samples were saved in `out`), or a weight is not
            finite (the last checkpoint was kept).
    """
    with join_processes() as processes:
        claim = _claim(out) if processes.is_first else nullcontext()
        with claim:
            run = Run(config, out, start, processes)
            for progress in run.steps(stopped):
                if report is not None and processes.is_first:
                    report(progress)
    return out


@contextmanager
def _claim(out: Path) -> Iterator[None]:
    """Lock the folder for this run.

    Raises:
        ValueError: another run writes there, or there are files that no run wrote.
    """
    with OutputFolder(out) as folder:
        if last_checkpoint(out) is None:
            folder.check_own_files(*WRITTEN_FILES, *WRITTEN_FOLDERS)
        # The files are recorded before they exist, because a run that is killed cannot record them later. As
        # they are marked as changing, the next run may replace them
        names = [CHECKPOINT, PREVIOUS_CHECKPOINT, *WRITTEN_FILES, *WRITTEN_FOLDERS]
        files_in_folders = [f"{pattern}/*" for pattern in WRITTEN_FOLDERS]
        folder.record(*names, *files_in_folders, changing=True)
        yield


@dataclass(frozen=True)
class Processes:
    """This process and the others of the run."""

    rank: int
    count: int
    device: torch.device

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and reports."""
        return self.rank == 0

    def wrap_ddp(self, module: nn.Module) -> nn.Module:
        """The module with gradients averaged over all processes; the module itself if there is only one process."""
        if self.count == 1 or not any(p.requires_grad for p in module.parameters()):
            return module
        devices = [self.device.index] if self.device.type == "cuda" else None
        return Ddp(module, device_ids=devices, find_unused_parameters=True)

    def gather(self, positions: list[ReplayPosition]) -> tuple[ReplayPosition, ...]:
        """The positions of the sample streams of all processes, given those of this process.

        A stream can be resumed at its position. The result is ordered by the number of the stream: stream n
        belongs to process n % `count`.
        """
        own = torch.tensor([[p.scene, p.sample, p.buffered] for p in positions], device=self.device)
        if self.count == 1:
            gathered = [own]
        else:
            gathered = [torch.empty_like(own) for _ in range(self.count)]
            torch.distributed.all_gather(gathered, own)
        # After stacking, the axes are (i, process, field), where i counts the streams of a process. Stream i of
        # process p has the number i * count + p, so flattening the first two axes orders streams by number
        by_number = torch.stack(gathered, 1).flatten(0, 1)
        return tuple(ReplayPosition(*position) for position in by_number.tolist())

    def mean(self, value: Tensor) -> Tensor:
        """The mean over the processes."""
        if self.count == 1:
            return value
        value = value.clone()
        torch.distributed.all_reduce(value)
        return value / self.count

    def maximum(self, *values: float) -> list[float]:
        """The maximum of each value over the processes, so that they decide alike if their clocks differ."""
        if self.count == 1:
            return list(values)
        own = torch.tensor(values, dtype=torch.float64, device=self.device)
        torch.distributed.all_reduce(own, torch.distributed.ReduceOp.MAX)
        return own.tolist()


@contextmanager
def join_processes() -> Iterator[Processes]:
    """Join the other processes if torchrun started this one, and leave when all are done."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    rank = int(os.environ.get("RANK", "0"))
    local = int(os.environ.get("LOCAL_RANK", "0"))
    device = torch.device("cuda", local) if torch.cuda.is_available() else torch.device("cpu")
    if count == 1:
        yield Processes(0, 1, device)
        return
    if device.type == "cuda":
        torch.cuda.set_device(device)
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield Processes(rank, count, device)
        # With gloo, a process that exits before the others can crash, because gloo's threads may still hold
        # the last tensors. So all wait here.
        torch.distributed.barrier()
    finally:
        torch.distributed.destroy_process_group()


class Pace(NamedTuple):
    """How fast a run is."""

    samples_per_s: float
    waiting: float
    """Fraction of the time that was spent waiting for samples."""
    eta_s: float
    """Estimated time to the end."""


class RunClock:
    """The times of a run: how far it is, how fast, and when the next checkpoint is due."""

    def __init__(self, config: TrainConfig, step: int, elapsed_s: float) -> None:
        """Start the clock of a run whose earlier parts made `step` steps in `elapsed_s`."""
        self.config = config
        self.first_step = step
        self.before_s = elapsed_s
        now = time.monotonic()
        self._began = now
        self._saved = now
        self._samples = 0
        self._waited_s = 0.0

    def elapsed_s(self) -> float:
        """Seconds that the run has taken, including its earlier parts."""
        return self.before_s + time.monotonic() - self._began

    def progress(self, step: int) -> float:
        """Fraction of the run that is done before `step`, by steps or by time, whichever is further."""
        by_steps = step / self.config.steps
        if not self.config.minutes:
            return by_steps
        by_time = self.elapsed_s() / (60 * self.config.minutes)
        return max(by_steps, by_time)

    def checkpoint_due(self) -> bool:
        """Whether `checkpoint_minutes` have passed since the last checkpoint."""
        return time.monotonic() - self._saved >= 60 * self.config.checkpoint_minutes

    def note_checkpoint(self) -> None:
        """Note that a checkpoint was written now."""
        self._saved = time.monotonic()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Count the time spent in the `with` block as waiting for samples."""
        began = time.monotonic()
        yield
        self._waited_s += time.monotonic() - began

    def note_samples(self, count: int) -> None:
        """Note that this number of samples was trained on."""
        self._samples += count

    def pace(self, step: int) -> Pace:
        """The pace after `step` steps."""
        span_s = max(time.monotonic() - self._began, 1e-9)
        left_s = (self.config.steps - step) * span_s / (step - self.first_step)
        if self.config.minutes:
            left_s = min(left_s, 60 * self.config.minutes - self.elapsed_s())
        return Pace(self._samples / span_s, self._waited_s / span_s, max(0.0, left_s))


class Run:
    """A run in this process: model, averages, optimisers and streams of samples."""

    def __init__(self, config: TrainConfig, out: Path, start: nn.Module | None, processes: Processes) -> None:
        out.mkdir(parents=True, exist_ok=True)
        torch.manual_seed(config.seed)
        if start is None and config.start is not None:
            start = config.objective.load_start(config.start)
        self.config = config
        self.out = out
        self.processes = processes
        run_config = _with_precision(config, processes.device)
        objective = config.objective.make_objective(run_config, config.objective, start)
        self.objective = objective.to(processes.device)
        self.model = self.objective.model
        self.average = AveragedModel(self.model, multi_avg_fn=averaging(config.ema))
        self.trained = [p for p in self.model.parameters() if p.requires_grad]
        self.optimizer = self.objective.make_optimizer(self.trained, config.learning_rate)
        self.adversary = self.objective.adversary
        self.state = RunState(step=0, elapsed_s=0.0, positions=())
        self.last_scores: dict[str, float | None] = {}
        """Scores of the latest validation of this process; {} before its first."""
        self._modules: dict[str, nn.Module] = {"model": self.model, "average": self.average}
        self._optimizers: dict[str, torch.optim.Optimizer] = {"optimizer": self.optimizer}
        if self.adversary is not None:
            self._modules["discriminator"] = self.adversary.discriminator.to(processes.device)
            self._optimizers["discriminator_optimizer"] = self.adversary.optimizer
        last = last_checkpoint(out)
        if last:
            self.state = load_run(last, config, self._modules, self._optimizers)
        self._check_same_checkpoint()
        self.ddp_objective = processes.wrap_ddp(self.objective)
        self.streams = self._make_streams()
        self.keeps_best = bool(config.scenes.hold_out and config.scenes.captures and config.validate_every)
        self.validation = self._make_validation()

    def _check_same_checkpoint(self) -> None:
        """Raise ValueError unless all processes resume from the same step."""
        step = float(self.state.step)
        minus_first, last = map(int, self.processes.maximum(-step, step))
        if last != -minus_first:
            raise ValueError(
                f"{self.out}: expected the same checkpoint in all processes, got steps {-minus_first} to {last}; "
                "use a folder that all machines share"
            )

    def steps(self, stopped: Callable[[], bool] = lambda: False) -> Iterator[Progress]:
        """Make the remaining steps, or those until `stopped` returns True; yields after each."""
        config = self.config
        first_step = self.state.step
        step = first_step
        clock = RunClock(config, first_step, self.state.elapsed_s)
        with Log(self.out, first_step, self.processes.is_first) as log:
            # Score the starting weights if they may be the best, or are the baseline for later scores
            scores_start = self.keeps_best or self.objective.scores_training_views
            if step == 0 and self.validation is not None and scores_start:
                self._validate(log, step, clock)
            while True:
                # One process that is done ends the run for all, and one that wants a checkpoint makes all save
                ends_now = stopped() or self._has_stopped_improving(step)
                own_progress = 1.0 if ends_now else clock.progress(step)
                wants_checkpoint = float(self._checkpoint_due(step, clock))
                progress, checkpoint_due = self.processes.maximum(own_progress, wants_checkpoint)
                if checkpoint_due:
                    self._save(step, clock)
                if progress >= 1:
                    break

                # Make a step
                with clock.waiting():
                    batches = [stream.batch(step, config.batch) for stream in self.streams]
                rate = config.learning_rate * self.objective.learning_rate_factor(
                    step, progress, config.warmup
                )
                for group in self.optimizer.param_groups:
                    group["lr"] = rate
                losses = self._step(step, batches)
                step += 1

                # Report it
                clock.note_samples(sum(map(len, batches)) * self.processes.count)
                pace = clock.pace(step)
                entry = Progress(
                    step=step,
                    progress=progress,
                    learning_rate=rate,
                    losses=losses,
                    elapsed_s=clock.elapsed_s(),
                    samples_per_s=pace.samples_per_s,
                    waiting=pace.waiting,
                    eta_s=pace.eta_s,
                    validation=self.last_scores,
                )
                log.add(entry)
                if self.validation is not None and step % config.validate_every == 0:
                    self._validate(log, step, clock)
                yield entry
            if step > self.state.step:
                self._save(step, clock)
            elif self.processes.is_first and not self.keeps_best:
                self._write_model(self.state)  # the run was complete already, but its model may be missing

            # The last steps have just been saved. Only then are they validated, because that takes long
            if config.validate_every:
                self._validate_last_steps(log, step, clock)

    def _make_validation(self) -> Validation | None:
        """The function that scores the model; None in processes that do not validate.

        A run that keeps the best weights is scored on views that its captures hold back. Other runs are scored
        by their objective's own validation.
        """
        if not self.config.validate_every or not self.processes.is_first:
            return None
        if self.keeps_best:
            scenes = self.config.scenes
            return HeldBackValidation(scenes.captures, str(scenes.hold_out))
        return self.objective.validation

    @property
    def averaged(self) -> nn.Module:
        """The model with averaged weights, which is the result."""
        return self.average.module

    def _validate(self, log: Log, step: int, clock: RunClock) -> None:
        """Score and log the averaged weights. A run that keeps the best writes them if their score is the best."""
        assert self.validation is not None, "the caller checked"
        scores = self.validation(self.averaged, self.out / f"validation-{step:06d}.png")
        first_scores = log.first_validation() or scores
        if TRAINED_SCORE in scores:
            scores |= {"overfit": memorised_gain(scores, first_scores)}
        self.last_scores = scores
        score = scores.get("score")
        best = self.state.best_score
        if self.keeps_best and score is not None and is_better(score, best):
            self.state = replace(self.state, best_score=score, best_step=step)
            self._write_model(replace(self.state, step=step, elapsed_s=clock.elapsed_s()))
        log.add_validation(step, scores)  # last, as a resumed run does not score a logged step again

    def _validate_last_steps(self, log: Log, step: int, clock: RunClock) -> None:
        """Validate the last weights; if they are the best, save again, because a checkpoint holds the best score.

        If a complete run that keeps the best weights was killed here, it catches up when it is resumed. Every
        process calls this: only the first validates, but all take part in saving.
        """
        has_better_weights = 0.0
        is_complete = clock.progress(step) >= 1 or self._has_stopped_improving(step)
        if self.validation is not None and (step > clock.first_step or (self.keeps_best and is_complete)):
            scored_steps = [scored for scored, _ in read_validations(self.out)]
            if step not in scored_steps:
                self._validate(log, step, clock)
                has_better_weights = float(self.keeps_best and self.state.best_step == step)
        (any_has_better_weights,) = self.processes.maximum(has_better_weights)
        if any_has_better_weights:
            self._save(step, clock)

    def _checkpoint_due(self, step: int, clock: RunClock) -> bool:
        """Whether to write a checkpoint: `checkpoint_minutes` after the last one, or after better weights.

        A checkpoint also holds the score of the best weights. With an older checkpoint, a resumed run
        would not know that score, and could replace the best weights with worse ones.
        """
        has_new_steps = step > self.state.step
        has_better_weights = self.state.best_step > self.state.step
        return has_new_steps and (has_better_weights or clock.checkpoint_due())

    def _has_stopped_improving(self, step: int) -> bool:
        """Whether a run that keeps the best weights found no better ones in the last `PATIENCE` validations."""
        if not self.processes.is_first or not self.keeps_best or self.state.best_score is None:
            return False
        waited = step - self.state.best_step
        return waited >= PATIENCE * self.config.validate_every

    def _step(self, step: int, batches: list[list[object]]) -> dict[str, float]:
        """Update all weights once, by the mean gradient over the samples of all streams."""
        self.optimizer.zero_grad(set_to_none=True)
        losses = []
        num_done = 0
        num_samples = sum(map(len, batches))
        for number, batch in enumerate(batches):
            stream = number * self.processes.count + self.processes.rank
            torch.manual_seed(step_seed(self.config.seed, step, stream))
            for piece in self._split(batch):
                share = len(piece) / num_samples
                num_done += len(piece)
                # Gradients accumulate; only the last backward pass averages them over the processes.
                is_last = num_done == num_samples
                with nullcontext() if is_last else self._without_sync():
                    samples = [to_device(sample, self.processes.device) for sample in piece]
                    terms = self._add_gradients(step, samples, share)
                values = torch.tensor([terms[name] for name in LOSSES], device=self.processes.device)
                losses.append(share * values)
        torch.nn.utils.clip_grad_norm_(self.trained, self.objective.max_grad_norm)
        self.optimizer.step()
        self.average.update_parameters(self.model)
        if self.adversary is not None:
            self.adversary.step(self.processes.mean)
        means = self.processes.mean(torch.stack(losses).sum(0)).tolist()
        return dict(zip(LOSSES, means, strict=True))

    def _without_sync(self) -> AbstractContextManager[None]:
        """A context in which gradients are not averaged over the processes."""
        return self.ddp_objective.no_sync() if isinstance(self.ddp_objective, Ddp) else nullcontext()

    def _split(self, batch: list[object]) -> list[list[object]]:
        """The batch in parts of at most `microbatch` samples."""
        size = self.config.microbatch or len(batch)
        return [batch[first : first + size] for first in range(0, len(batch), size)]

    def _add_gradients(self, step: int, samples: list[object], share: float) -> dict[str, float]:
        """Add the gradients of these samples' loss, multiplied by `share`; returns the `LOSSES` by name."""
        output = self.ddp_objective(samples)
        assert isinstance(output, StepOutput)
        total = output.total
        adversarial = 0.0
        discriminator = 0.0
        if self.adversary is not None:
            assert output.judged is not None, "objectives with an adversary return its discriminator's input"
            term, discriminator = self.adversary.losses(output.judged, share)
            total = total + self.adversary.weight * term
            adversarial = float(term.detach())
        self._check_finite(total.detach(), step, samples)
        (total * share).backward()
        return {
            "inside": float(output.image.inside.detach()),
            "outside": float(output.image.outside.detach()),
            "total": float(total.detach()),
            "adversarial": adversarial,
            "discriminator": discriminator,
        }

    def _check_finite(self, total: Tensor, step: int, batch: list[object]) -> None:
        """Raise a FloatingPointError if the loss of these samples is not finite, after saving them."""
        if torch.isfinite(total):
            return
        folder = self.out / f"not-finite-{step:06d}"
        folder.mkdir(exist_ok=True)
        for number, sample in enumerate(batch):
            data = sample_to_bytes(sample)
            file = folder / f"{self.processes.rank}-{number:02d}.safetensors"
            write_atomically(file, lambda path, data=data: path.write_bytes(data))
        raise FloatingPointError(
            f"expected a finite loss, got {float(total)} at step {step}; inspect its samples in {folder}, or lower "
            "the learning rate and resume from the last checkpoint"
        )

    def _make_streams(self) -> list[SampleReplay[object]]:
        """The sample streams of this process: every n-th of all streams, for n processes."""
        config = self.config
        processes = self.processes
        num_streams = max(config.streams, processes.count)
        if num_streams % processes.count:
            raise ValueError(
                "expected the same number of streams for each process, "
                f"got {num_streams} for {processes.count}; change either"
            )
        if self.state.positions and len(self.state.positions) != num_streams:
            raise ValueError(
                f"expected the {len(self.state.positions)} streams of the earlier part of the run, "
                f"got {num_streams}; start the same number of processes again"
            )
        streams = []
        for number in range(processes.rank, num_streams, processes.count):
            seed = f"{config.seed}/{number}"
            position = self.state.positions[number] if self.state.positions else None
            scenes = self.objective.training_scenes(seed)
            streams.append(
                SampleReplay(scenes, seed, config.new_per_batch, config.replay_size, config.workers, position)
            )
        return streams

    def _save(self, step: int, clock: RunClock) -> None:
        """Write a checkpoint, and the averaged weights unless the run keeps the best ones."""
        positions = self.processes.gather([stream.position for stream in self.streams])
        self.state = replace(self.state, step=step, elapsed_s=clock.elapsed_s(), positions=positions)
        if self.processes.is_first:
            save_run(self.out, self.config, self.state, self._modules, self._optimizers)
            if not self.keeps_best:
                self._write_model(self.state)
        clock.note_checkpoint()

    def _write_model(self, state: RunState) -> None:
        """Write the averaged weights, with a card that states the steps and the time of `state`."""
        num_streams = len(self.streams) * self.processes.count
        card = model_card(self.config, state, num_streams, self.objective.loss_summary)
        self.objective.save(self.averaged, self.out, card)


def memorised_gain(scores: Mapping[str, float | None], first: Mapping[str, float | None]) -> float | None:
    """The gain on views that the run trained on, minus that on new views of the same people, dB.

    Gains are relative to the scores of the first validation. None if a score is missing.
    """

    def gain(name: str) -> float | None:
        now = scores.get(name)
        before = first.get(name)
        return None if now is None or before is None else now - before

    on_training_views = gain(TRAINED_SCORE)
    on_new_views = gain(NEW_VIEWS_SCORE)
    if on_training_views is None or on_new_views is None:
        return None
    return on_training_views - on_new_views


def step_seed(seed: int, step: int, stream: int) -> int:
    """The seed of the random numbers of one stream in one step, whichever process computes it.

    It is different for each step and stream of runs of up to 1,000,003 steps and 1,009 streams.
    """
    return (seed * 1_000_003 + step) * 1_009 + stream


def _with_precision(config: TrainConfig, device: torch.device) -> TrainConfig:
    """The config with a definite precision: `auto` becomes the one that is faster on the device.

    The run's files keep `auto`, because the run may be resumed on another machine.
    """
    if config.precision != "auto":
        return config
    return replace(config, precision="bfloat16" if faster_dtype(device) == torch.bfloat16 else "float32")


def averaging(decay: float) -> Callable[[Sequence[Tensor], Sequence[Tensor], Tensor | int], None]:
    """The update rule of the averaged weights: each step multiplies their difference from the weights by `decay`.

    They move faster in the first steps, so that the initial weights do not stay in the average.
    """

    @torch.no_grad()
    def update(averages: Sequence[Tensor], weights: Sequence[Tensor], count: Tensor | int) -> None:
        kept = min(decay, (1 + int(count)) / (10 + int(count)))
        for average, weight in zip(averages, weights, strict=True):
            average.lerp_(weight, 1 - kept)

    return update
