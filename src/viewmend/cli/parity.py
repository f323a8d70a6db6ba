"""`viewmend evaluate parity`: compare our baselines with the published networks."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Compare DSTT, FuseFormer and E2FGVI, and their variants with memory, with outputs of the published networks.

    Each file names the network, and the seed of its weights and input. Prints the largest absolute difference; the exit
    code is 1 if one is above 1e-3 or not a number.
    """

    files: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Parity files (.npz)."""
    device: str = "cpu"
    """Device: cpu, or cuda."""
    json: bool = False
    """Write one JSON list to standard output and nothing else there."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    from dataclasses import asdict

    from viewmend.cli.checks import check_device
    from viewmend.cli.console import busy, print_json, show
    from viewmend.contrib.baselines.parity import TOLERANCE, check

    if not options.files:
        raise ValueError("expected one or more parity files, got none; see viewmend evaluate parity --help")
    check_device(options.device)
    results = []
    for path in options.files:
        with busy(f"running the network of {path.name}"):
            result = check(path, options.device)
        results.append({"file": str(path), **asdict(result), "passed": result.passed})
        if not options.json:
            verdict = "passed" if result.passed else f"FAILED: above {TOLERANCE:g}"
            show(
                f"{path}: {result.name}, {result.frames} frames, seed {result.seed}: largest difference "
                f"{result.difference:.2e} (means {result.mean_difference:.2e}, standard deviations "
                f"{result.std_difference:.2e}): {verdict}"
            )
    if options.json:
        print_json(results)
    return 0 if all(result["passed"] for result in results) else 1
