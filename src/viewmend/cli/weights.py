"""`viewmend weights`: list and check the published weights of third-party networks."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """List the third-party weights that metrics and baselines can use, or check files of them.

    Metrics and baselines without weights are n/a. LPIPS with AlexNet ships with this package, and viewmend weights get
    downloads the other metrics' networks. Put all others into one of the listed folders, or name a folder in
    VIEWMEND_WEIGHTS.
    """

    files: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[FILE...]")] = ()
    """Files to check; without any, all known weights are listed."""
    name: str | None = None
    """Name of the weights that the files should be; by default found by file name, or else by hash."""
    json: bool = False
    """Write one JSON value to standard output and nothing else there."""


def run(options: Options) -> int:
    """Run the command; 1 if a file is wrong, else 0."""
    from viewmend.cli.console import print_json, show
    from viewmend.metrics.weights import KNOWN, find_weights, weight_folders

    if options.files:
        found = [_check_file(path, options.name) for path in options.files]
    else:
        found = [_describe(known.name, find_weights(known)) for known in KNOWN]
    if options.json:
        print_json(found)
    else:
        for line in found:
            where = line["path"] or f"expected as {line['files']}, from {line['source']}"
            show(f"{line['name']}: {line['status']}: {where}")
            show(f"    {line['what']}; licence: {line['licence']}; {line['hash']}")
            if line["error"]:
                show(f"    {line['error']}")
        if not options.files:
            show("searched: " + ", ".join(map(str, weight_folders())))
    return 1 if any(line["status"] == "wrong" for line in found) else 0


def _check_file(path: Path, name: str | None) -> dict[str, str]:
    from viewmend.contrib.baselines.published import NETWORKS
    from viewmend.metrics.weights import KNOWN, has_published_hash
    from viewmend.utils.weight_files import WeightsError, load_weights

    if not path.is_file():
        raise ValueError(f"{path}: expected a file of weights, found none; check the path")
    if name is None:
        by_name = [k.name for k in KNOWN if any(Path(file).name == path.name for file in k.files)]
        by_hash = [k.name for k in KNOWN if k.sha256 and has_published_hash(path, k)]
        if not by_name + by_hash:
            names = ", ".join(k.name for k in KNOWN)
            raise ValueError(
                f"{path}: expected known weights, got a file of another name and hash; give --name {names}"
            )
        name = (by_hash + by_name)[0]
    line = _describe(name, path)
    if name not in NETWORKS:
        return line
    try:  # no hash was published: load the file
        load_weights(NETWORKS[name](), path)
    except WeightsError as error:
        return line | {"status": "wrong", "error": str(error)}
    return line | {"status": "right by all names and shapes"}


def _describe(name: str, path: Path | None) -> dict[str, str]:
    from viewmend.metrics.weights import known_weights, stated_hash, verify_weights
    from viewmend.utils.weight_files import WeightsError

    known, status, problem = known_weights(name), "missing", ""
    if path is not None:
        status = "right" if known.sha256 else "there (no hash was published; loading checks shapes)"
        try:
            verify_weights(path, known)
        except WeightsError as error:
            status, problem = "wrong", str(error)
    return {
        "name": name,
        "status": status,
        "path": "" if path is None else str(path),
        "files": " or ".join(known.files),
        "what": known.what,
        "source": known.source,
        "licence": known.licence,
        "hash": stated_hash(known),
        "error": problem,
    }
