"""`viewmend weights`: list the published weights of third-party networks."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viewmend.metrics.weights import KnownWeights


@dataclass(frozen=True, kw_only=True)
class Options:
    """List the third-party weights that metrics and baselines can use, and verify those that are installed.

    Metrics and baselines without weights are n/a. LPIPS with AlexNet ships with this package, and
    `viewmend weights get` downloads the networks of other metrics. Put any other weights into one of
    the listed folders, or into the folder that VIEWMEND_WEIGHTS names.
    """

    json: bool = False
    """Write the list to standard output as JSON, and nothing else."""


def run(options: Options) -> int:
    """Run the command; 1 if a file is wrong, else 0."""
    from viewmend.cli.console import print_json, show
    from viewmend.metrics.weights import KNOWN, find_weights, weight_folders

    found = [_describe(known, find_weights(known)) for known in KNOWN]
    if options.json:
        print_json(found)
    else:
        for line in found:
            where = line["path"] or f"expected as {line['files']}, from {line['source']}"
            show(f"{line['name']}: {line['status']}: {where}")
            show(f"    {line['what']}; licence: {line['licence']}; {line['hash']}")
            if line["error"]:
                show(f"    {line['error']}")
        show("searched: " + ", ".join(map(str, weight_folders())))
    return 1 if any(line["status"] == "wrong" for line in found) else 0


def _describe(known: "KnownWeights", path: Path | None) -> dict[str, str]:
    from viewmend.metrics.weights import stated_hash, verify_weights
    from viewmend.utils.weight_files import WeightsError

    status = "missing"
    problem = ""
    if path is not None:
        status = "verified" if known.sha256 else "found (no hash was published; loading checks shapes)"
        try:
            verify_weights(path, known)
        except WeightsError as error:
            status = "wrong"
            problem = str(error)
    return {
        "name": known.name,
        "status": status,
        "path": "" if path is None else str(path),
        "files": " or ".join(known.files),
        "what": known.what,
        "source": known.source,
        "licence": known.licence,
        "hash": stated_hash(known),
        "error": problem,
    }
