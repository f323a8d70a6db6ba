"""Compare exported models with the Python model: python benchmarks/exported.py MODEL.pt2 MODEL.onnx [--write].

Each file completes random views of random people, sizes and rigs; its outputs are compared with the Python model's.
Exported models keep artefact islands around the subject, so the Python model keeps them here, too.
Then the processor time of one view of 320 x 320 pixels with eight cameras is measured on one thread.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from unittest import mock

import onnxruntime
import tests_path  # noqa: F401
import torch
from measure import timed, write
from reference.random_views import holed, images, mended, random_view

from viewmend import Stream, StreamConfig, load_inpainter
from viewmend.export.traceable import ViewInputs, ViewOutputs
from viewmend.models.base import ContextProvider
from viewmend.models.views import prediction
from viewmend.models.views.model import ViewSynthNet
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig

TOLERANCE = 1e-3
Runner = Callable[[ViewInputs], Sequence[torch.Tensor]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("files", nargs="+", type=Path, help="files written by viewmend export from --model")
    parser.add_argument("--model", default="views", help="the exported model")
    parser.add_argument("--scenes", type=int, default=50, help="number of random views")
    parser.add_argument("--runs", type=int, default=10, help="repetitions of the timed view")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    torch.set_num_threads(1)
    net = load_inpainter(options.model, precision="float32")
    assert isinstance(net, ViewSynthNet)
    runners = {file.suffix[1:]: runner_of(file) for file in options.files}
    with mock.patch.object(prediction, "artefact_islands", no_islands):
        found = {name: {"apart": apart} for name, apart in compared(net, runners, options.scenes).items()}
    for name, taken in times(net, runners, options.runs).items():
        found.setdefault(name, {})["view_320_8_cameras_cpu"] = taken
    config = {"model": options.model, "scenes": options.scenes, "tolerance": TOLERANCE}
    print(write("exported", "cpu", config, found) if options.write else json.dumps(found, indent=1))


def no_islands(rgba: torch.Tensor, predicted: torch.Tensor) -> None:
    """Replaces `artefact_islands`: no pixel is removed."""


def runner_of(file: Path) -> Runner:
    """A function that runs the file on one thread."""
    if file.suffix == ".pt2":
        package = torch._inductor.aoti_load_package(str(file))
        return lambda given: package(*given)
    threads = onnxruntime.SessionOptions()
    threads.intra_op_num_threads = threads.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(file, threads)
    names = [own.name for own in session.get_inputs()]
    return lambda given: [
        torch.from_numpy(image)
        for image in session.run(None, {name: getattr(given, name).numpy() for name in names})
    ]


def compared(net: ViewSynthNet, runners: dict[str, Runner], scenes: int) -> dict[str, dict[str, float]]:
    """Largest differences of each file's outputs from the model's, over all pixels of all views."""
    furthest: dict[str, dict[str, list[float]]] = {name: {} for name in runners}
    over, pixels, views = dict.fromkeys(runners, 0), 0, dict.fromkeys(runners, 0)
    for seed in range(scenes):
        view, context = random_view(seed, net)
        view = holed(view) if seed % 2 else view
        wanted = images(mended(net, view, context))
        given = ViewInputs.of(view, context, net.config.num_views)
        pixels += view.mask.numel()
        for name, run in runners.items():
            off = {
                output: (own - wanted[output]).abs()
                for output, own in zip(ViewOutputs._fields, run(given), strict=True)
            }
            for output, image in off.items():
                furthest[name].setdefault(output, []).append(float(image.max()))
            wrong = torch.stack(
                [image.reshape(-1, *view.mask.shape).amax(0) > TOLERANCE for image in off.values()]
            )
            over[name] += int(wrong.any(0).sum())
            views[name] += bool(wrong.any())
        print(
            f"{seed}: {tuple(view.mask.shape)}",
            {n: max(f["completed_rgb"]) for n, f in furthest.items()},
            flush=True,
        )
    return {
        name: {f"largest_{output}": max(values) for output, values in furthest[name].items()}
        | {"median_of_largest_rgb": median(furthest[name]["completed_rgb"])}
        | {"views_over": views[name], "pixels_over": over[name], "pixels": pixels}
        for name in runners
    }


def times(net: ViewSynthNet, runners: dict[str, Runner], runs: int) -> dict[str, dict[str, float]]:
    """Milliseconds of processor time per view of the model and of each file."""
    frame = Studio(StudioConfig(seed=10003, cameras=8, frames=1, size_px=320)).read(0)
    stream = Stream(net, StreamConfig())
    seen = stream.add_frame(frame)
    view = stream.render(orbit([0.4], (320, 320), elevation_rad=0.2))
    given = ViewInputs.of(view, ContextProvider(lambda _, names: seen.context(names)), net.config.num_views)
    work: dict[str, Callable[[], object]] = {
        "eager": lambda: mended(net, view, ContextProvider(lambda _, names: seen.context(names)))
    }
    work |= {name: (lambda run=run: run(given)) for name, run in runners.items()}
    return {name: timed(one, runs=runs, clock=time.process_time) for name, one in work.items()}


if __name__ == "__main__":
    main()
