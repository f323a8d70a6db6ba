"""What an evaluation found, ready to be written in any form."""

from collections.abc import Sequence
from dataclasses import dataclass

from viewmend.evaluation.averages import Table, tables, tables_by_kind
from viewmend.evaluation.cells import PROTOCOL, Cell
from viewmend.evaluation.provenance import Provenance
from viewmend.evaluation.records import Records, records
from viewmend.evaluation.scene_run import SLOW_MS, RunSettings
from viewmend.methods import REFERENCE
from viewmend.metrics.view_scores import ENOUGH_HOLE_PX

RULES = (
    "One camera is left out, with its mask; its view is carved and rendered from the others, and completed as a "
    "stream: one frame at a time, from past frames only. All methods complete the same rendered views.",
    "Holes are the proxy's pixels that no camera in use colours, not dilated: E by the rule 'unseen', and the same for "
    "scores whatever the methods were asked to mend. The truth is the left-out camera's image on black, or on white "
    "where the setting says so: then classical fills and published networks are shown the view on white, too, and a "
    "model of ours what it was trained on, its result laid on white by its alpha, or M.",
    'Each score has four readings: "whole", over all pixels; "holes", over the holes alone (a); "in mask", over '
    'those of them inside the true mask; "masked", of both images blackened outside the holes, over all pixels (b). '
    'SSIM and LPIPS in "holes" and "in mask" are means of their maps there, of unmasked images.',
    '"Rendered" is the PSNR over all pixels before anything is mended, "subject" that inside the true mask; "alpha '
    "IoU\" is the overlap of alpha above one half (without alpha: of the proxy's mask) with the true mask.",
    '"Only past" is the PSNR over the holes whose true surface none of the cameras that colour the view sees now, and '
    "one of them saw 1, 2, 3, 10, 20 or 30 frames ago, by true depth; known for P-long, Q-long and P-turn alone, whose "
    "last frames are scored, with a whole past.",
    "SSIM: Gaussian window of 11 x 11 pixels, sigma 1.5, unless the setting says another; mean of the channels; only "
    "windows that lie in the image.",
    "LPIPS 0.1 of AlexNet and VGG16. VFID: I3D's Mixed_5c, a mean vector for each video of up to 16 frames in [0, 1], "
    "Frechet distance over all videos of the table; I3D in evaluation mode, and as published scripts run it, in "
    'training mode ("train"). Networks without their weights are n/a.',
    f"Frames with fewer than {ENOUGH_HOLE_PX} pixels of the kind are left out of scores in the holes, and counted.",
    "Means are over the frames of a scene, then over the scenes of a set, then over sets.",
    "Methods see the cameras' past and their own results, never the left-out camera; rgvi alone sees its truth of past "
    "frames, as in the paper, and is no fair rival.",
    f"The gain over {REFERENCE} is the mean over the scenes in which both have a score.",
    '"Flicker" is how much the error, completed view minus truth, differs from that of the frame before, warped by the '
    "true motion of the surface: mean absolute difference over the holes, in 255ths; the truth has 0.",
    '"Warp" is the mean absolute difference from the frame before, warped in the same way, over the holes '
    '(in 255ths); "change" is that in place, over the holes of now or then. The truth is not 0 in '
    "either: see its row.",
    "Milliseconds are the inpainter's step alone (not hull and rendering), with its caches as in production, over the "
    "frames with holes: FPS by their mean, median, 95th percentile. Each stream's first step is run twice and the "
    f"second is timed, so that nothing is compiled in it; what takes {SLOW_MS / 1000:.0f} s is not run again.",
)
"""What the figures mean; every report says so."""


@dataclass(frozen=True)
class Report:
    """All figures of an evaluation."""

    protocol: int
    settings: RunSettings
    methods: tuple[str, ...]
    identities: dict[str, str]
    """What each method is: class, parameters, hash of its weights."""
    tables: tuple[Table, ...]
    """Over all sets if there are several, then each set."""
    kinds: tuple[Table, ...]
    """Each set's rigs and styles."""
    scores: Records
    """Every figure of every method and scene."""
    cells: tuple[Cell, ...]
    """All of them, also those that failed."""
    missing: dict[str, str]
    """Methods without what they need here, which have no cells, and the reason: their rows are n/a."""
    missing_networks: dict[str, str]
    """Networks of metrics without their weights, and the reason: their scores are n/a."""
    origins: tuple[Provenance, ...]
    """Where the cells were computed: several if runs were resumed."""


def make_report(
    cells: Sequence[Cell],
    methods: tuple[str, ...],
    settings: RunSettings,
    missing: dict[str, str] | None = None,
    missing_networks: dict[str, str] | None = None,
) -> Report:
    """Average the cells, in the order of scenes and methods in which they come."""
    identities = {cell.key.method: cell.identity for cell in cells}
    origins = tuple(dict.fromkeys(cell.provenance for cell in cells))
    return Report(
        protocol=PROTOCOL,
        settings=settings,
        methods=methods,
        identities=identities,
        tables=tuple(tables(cells, methods)),
        kinds=tuple(tables_by_kind(cells, methods)),
        scores=records(cells),
        cells=tuple(cells),
        missing=missing or {},
        missing_networks=missing_networks or {},
        origins=origins,
    )
