"""How far a call travels through the package: the files that it enters, and the calls that go up.

    python research/trace_calls.py [mend] [render] [train]

A hand-over is a call from one file of the package to a function of another; each pair of caller's file and function
counts once. It goes up if the function's layer is above the caller's in pyproject.toml. `mend` is the command on a
small capture, `render` a second view of `Renderer.render`, and `train` the second step of a tiny model.
"""

import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import tyro

import viewmend
from viewmend.cli import main as run_command
from viewmend.geometry.hull import HullConfig
from viewmend.live.frame_source import RecordedSource
from viewmend.live.renderer import Renderer, RenderRequest
from viewmend.models.base import RenderQuality
from viewmend.models.checkpoint import load_inpainter
from viewmend.models.views.config import ViewsConfig
from viewmend.stream import StreamConfig
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.training.config import SamplingConfig, SceneConfig, TrainConfig
from viewmend.training.loop import Run, join_processes
from viewmend.training.views import ViewsObjectiveConfig

ROOT = Path(__file__).resolve().parents[1]
"""The repository has this path."""
SRC = Path(viewmend.__file__).parent
"""The package has this path."""
STAGE = StudioConfig(cameras=6, frames=2, size_px=96)
"""The capture of `mend` and `render`."""


@dataclass(frozen=True)
class HandOver:
    """A call from one file of the package to a function of another."""

    caller: str
    """The calling file, relative to the package."""
    file: str
    """The called file."""
    function: str

    def __str__(self) -> str:
        return f"{self.caller} -> {self.file}:{self.function}"


class CallTrace:
    """The hand-overs of this thread in `recording`, each once, in the order of their first calls."""

    def __init__(self, src: Path, layers: list[str]) -> None:
        self._src = f"{src}/"
        self._floors = {name: -floor for floor, group in enumerate(layers) for name in group.split(" | ")}
        self.hand_overs: list[HandOver] = []

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Record the calls within."""
        sys.setprofile(self._note)
        try:
            yield
        finally:
            sys.setprofile(None)

    def floor(self, file: str) -> int:
        """The layer of a file, counted from the top down to negative numbers; 1 for files in no layer, as `contrib`."""
        return self._floors.get(file.partition("/")[0].removesuffix(".py"), 1)

    @property
    def files(self) -> set[str]:
        """All files that were entered."""
        return {hand_over.file for hand_over in self.hand_overs}

    @property
    def up(self) -> list[HandOver]:
        """The hand-overs to a higher layer."""
        return [call for call in self.hand_overs if self.floor(call.file) > self.floor(call.caller)]

    def _note(self, frame: FrameType, event: str, _: Any) -> None:
        file = self._file_of(frame)
        if event != "call" or file is None or frame.f_code.co_name.startswith("<"):
            return
        outer = frame.f_back
        while outer is not None and self._file_of(outer) is None:
            outer = outer.f_back
        caller = None if outer is None else self._file_of(outer)
        if caller is not None and caller != file:
            hand_over = HandOver(caller, file, frame.f_code.co_qualname)
            if hand_over not in self.hand_overs:
                self.hand_overs.append(hand_over)

    def _file_of(self, frame: FrameType) -> str | None:
        path = frame.f_code.co_filename
        return path.removeprefix(self._src) if path.startswith(self._src) else None


def trace_mend(trace: CallTrace, folder: Path) -> None:
    """Record `viewmend mend`, which leaves out a camera."""
    run_command(["studio", str(folder / "studio"), "--scenes", "1", "--cameras", "6", "--frames", "1"])
    capture = folder / "studio/scene_00000"
    with trace.recording():
        run_command(
            ["mend", str(capture), "--leave-out", "cam03", "--scale", "0.3", "--out", str(folder / "out")]
        )


def trace_render(trace: CallTrace, folder: Path) -> None:
    """Record the second view that a viewer requests of a frame."""
    source = RecordedSource(lambda: Studio(STAGE))
    source.start()
    while source.read(0) is None:
        time.sleep(0.1)
    config = StreamConfig(hull=HullConfig(resolution=48))
    renderer = Renderer(source, load_inpainter("views"), config)
    renderer.prepare(0)
    request = RenderRequest(0, (Studio(STAGE).cameras[[0]],), RenderQuality())
    first = renderer.render(request, None)
    with trace.recording():
        renderer.render(request, first.viewer)
    source.stop()


def trace_train(trace: CallTrace, folder: Path) -> None:
    """Record the second step of a run."""
    scenes = SceneConfig(sizes_px=(96,), cameras=(5, 6), num_holdout_views=1, hull_resolution=48)
    model = ViewsConfig(num_views=4, width=8, sample_channels=4, features=8, fine_features=8)
    objective = ViewsObjectiveConfig(model=model, sampling=SamplingConfig(num_ray_views=4))
    config = TrainConfig(
        name="traced",
        objective=objective,
        scenes=scenes,
        steps=3,
        batch=1,
        new_per_batch=1,
        replay_size=2,
        workers=0,
        validate_every=0,
    )
    with join_processes() as processes:
        steps = Run(config, folder / "run", None, processes).steps()
        next(steps)
        with trace.recording():
            next(steps)
        steps.close()


TRIPS: dict[str, Callable[[CallTrace, Path], None]] = {
    "mend": trace_mend,
    "render": trace_render,
    "train": trace_train,
}
"""The calls that can be traced."""


def main(trips: tyro.conf.Positional[tuple[str, ...]] = tuple(TRIPS), show: bool = False) -> None:
    """Print how many hand-overs, files and calls up each trip has.

    Args:
        trips: the calls to trace, among mend, render and train.
        show: print all hand-overs; those that go up are marked.
    """
    unknown = set(trips) - set(TRIPS)
    if unknown:
        raise SystemExit(f"expected {', '.join(TRIPS)}, got {', '.join(unknown)}; check the spelling")
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    for name in trips:
        trace = CallTrace(SRC, contracts[0]["layers"])
        with tempfile.TemporaryDirectory() as folder:
            TRIPS[name](trace, Path(folder))
        counts = f"{len(trace.hand_overs)} hand-overs, {len(trace.files)} files"
        print(f"{name}: {counts}, {len(trace.up)} calls up")
        if show:
            up = set(trace.up)
            print(*(f"    {'UP ' if call in up else '   '}{call}" for call in trace.hand_overs), sep="\n")


if __name__ == "__main__":
    tyro.cli(main)
