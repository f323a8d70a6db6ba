"""How one mistake in a good capture is handled: refused, named in a warning, harmless, or silent.

    python research/corruptions.py CAPTURE [--count N] [--first N] [--write]
    python research/corruptions.py studio [--count N] [--first N] [--write]

Corruption number n follows from seed n. Each corrupted capture is opened and prepared as in `viewmend mend`. The view
of the camera nearest to the corrupted one is rendered from the others and compared with that of the good capture.
"""

import argparse
import logging
import math
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import benchmarks_path  # noqa: F401
import cv2
from corruptions_lib import corrupt, middle
from measure import write

from viewmend.data.capture_folder import open_capture
from viewmend.data.native_writer import write_capture
from viewmend.data.prepare import open_masked, prepare
from viewmend.data.source import CaptureSubset
from viewmend.mending import Mender
from viewmend.models.classical import Telea
from viewmend.studio.stage import Studio, StudioConfig

LEAST_LOSS_DB = 0.5


LONGEST_PX = 384


MOST_CAMERAS = 10


LEAST_SHIFT_PX = 0.25
"""A shift of all images counts as reported if it differs by this much from the good capture's."""


@dataclass(frozen=True)
class Outcome:
    """How one corruption was handled."""

    seed: int
    what: str
    camera: str
    kind: str
    """'refused', 'named', 'misnamed' (about another camera or cause; also refusals), 'mixed' (both), 'harmless' or
    'silent'."""
    said: str
    loss_db: float | None


class Judge:
    """Compares corrupted captures with the good one."""

    def __init__(self, good: Path):
        self.good = good
        capture = open_capture(good)
        self.names = capture.cameras.names
        self.centers = capture.cameras.centers
        self.time = middle(len(capture.frame_ids))
        self.fps = capture.fps or 1.0
        self._scores: dict[str, float] = {}
        self._offsets: dict[str, tuple[float, float]] = {}

    def outcome(self, seed: int) -> Outcome:
        with tempfile.TemporaryDirectory() as place:
            what, camera, cause = corrupt(self.good, Path(place) / self.good.name, seed)
            held = self._neighbour(camera)
            if held not in self._scores:
                self._scores[held] = self._score(self.good, held, [])
            said: list[str] = []
            try:
                score = self._score(Path(place) / self.good.name, held, said)
            except ValueError as error:
                kind = "refused" if re.search(cause, str(error)) else "misnamed"
                return Outcome(seed, what, camera, kind, str(error), None)
        loss = self._scores[held] - score
        kind = "harmless" if loss < LEAST_LOSS_DB else "silent"
        if said:
            whole = any(word in what for word in ("all", "two cameras", "metres_per_unit", "convention"))
            place = any((whole or camera in text) and re.search(cause, text) for text in said)
            accused = {name for text in said for name in re.findall(r"'(\w+)'", text) if name in self.names}
            kind = "misnamed" if not place else "named" if whole or accused <= {camera} else "mixed"
        return Outcome(seed, what, camera, kind, "; ".join(said), loss)

    def _neighbour(self, camera: str) -> str:
        """The nearest other camera."""
        view = self.names.index(camera) if camera in self.names else 0
        away = (self.centers - self.centers[view]).norm(dim=-1)
        away[view] = math.inf
        return self.names[int(away.argmin())]

    def _score(self, folder: Path, held: str, said: list[str]) -> float:
        """PSNR of the held-out camera's whole view; log messages are appended to `said`."""
        handler = logging.Handler()
        handler.emit = lambda record: said.append(record.getMessage())  # type: ignore[method-assign]
        log = logging.getLogger("viewmend")
        log.addHandler(handler)
        log.propagate = False
        try:
            source = open_masked(folder, held=1)
            inputs = [name for name in source.cameras.names if name != held]
            clock = open_capture(folder).clock  # some films of half the rate set the times
            time = self.time if clock is None else int(abs(clock.times_s - self.time / self.fps).argmin())
            capture = prepare(source, inputs, first=time)
            offset = capture.alignment.offset_px if capture.alignment else (0.0, 0.0)
            if folder == self.good:
                self._offsets[held] = offset
            elif math.dist(offset, self._offsets[held]) > LEAST_SHIFT_PX:
                said.append(f"all principal points moved by {offset}")
            frame = capture.read(time)
        finally:
            log.removeHandler(handler)
        truth = open_capture(self.good).read(self.time).select([held])
        step = Mender(Telea(), bounds=capture.bounds, exclude=[held]).mend(
            frame.without([held]), capture.cameras.select([held]), truth
        )
        assert step.scores is not None
        return float(step.scores.ours.psnr_whole or 0.0)


def good_capture(name: str, folder: Path) -> Path:
    """A studio capture, or a small part of a real one."""
    if name == "studio":
        source = Studio(
            StudioConfig(seed=10002, cameras=8, frames=10, fps=15, size_px=192, background="stage")
        )
    else:
        opened = open_capture(name)
        opened = open_capture(name, opened.cameras.names[:: -(-len(opened.cameras) // MOST_CAMERAS)])
        source = CaptureSubset(
            opened,
            times=range(min(len(opened.frame_ids), 10)),
            scale=LONGEST_PX / max(opened.cameras.max_size_px),
        )
    write_capture(source, folder / "good", images="png")
    for file in (folder / "good/mask").glob("*/*.png"):  # two levels, as in masks of other tools
        cv2.imwrite(str(file), 255 * (cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) > 127).astype("uint8"))
    return folder / "good"


def outcomes(name: str, seeds: range) -> Iterator[Outcome]:
    with tempfile.TemporaryDirectory() as place:
        judge = Judge(good_capture(name, Path(place)))
        for seed in seeds:
            yield judge.outcome(seed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("capture")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    counts: Counter[str] = Counter()
    losses = []
    for outcome in outcomes(options.capture, range(options.first, options.first + options.count)):
        counts[outcome.kind] += 1
        loss = "" if outcome.loss_db is None else f"{outcome.loss_db:.2f} dB"
        print(
            f"{outcome.seed:4d} {outcome.kind:8s} {loss:>9s}  {outcome.camera}: {outcome.what} | {outcome.said}",
            flush=True,
        )
        losses.append(outcome.__dict__)
    print(dict(counts))
    if options.write:
        name, config = Path(options.capture).name, {"first": options.first, "count": options.count}
        write(f"corruptions-{name}", "cpu", config, {"counts": dict(counts), "outcomes": losses})


if __name__ == "__main__":
    main()
