"""`viewmend weights`: what others trained and this package can use, where it is looked for, and whether it is right."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """List the weights of others' networks that can be used here, or check a file of them.

    None of them come with this package and none are ever downloaded: metrics and baselines without theirs are n/a.
    Put files into one of the folders that are listed, or name a folder in VIEWMEND_WEIGHTS.
    """

    files: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[FILE...]")] = ()
    """Files to check; none lists what is known."""
    name: str | None = None
    """What the files should be; by default what their names, or else their hashes, say."""
    json: bool = False
    """Write one JSON value to standard output and nothing else there."""


def run(options: Options) -> int:
    """Run the command; 1 if a file is not what it should be, else 0."""
    from viewmend.cli.console import print_json, show
    from viewmend.metrics.weights import places

    if options.files:
        found = [_checked(path, options.name) for path in options.files]
    else:
        found = _listed()
    if options.json:
        print_json(found)
    else:
        for line in found:
            where = line["path"] or f"wanted as {line['files']}, from {line['source']}"
            show(f"{line['name']}: {line['status']}: {where}")
            show(f"    {line['what']}; licence: {line['licence']}; {line['hash']}")
            if line["said"]:
                show(f"    {line['said']}")
        if not options.files:
            show("looked in: " + ", ".join(str(place) for place in places()))
    return 1 if any(line["status"] == "wrong" for line in found) else 0


def _listed() -> list[dict[str, str]]:
    from viewmend.metrics.weights import KNOWN, find_weights

    return [_line(known.name, find_weights(known)) for known in KNOWN]


def _checked(path: Path, name: str | None) -> dict[str, str]:
    from viewmend.baselines.published import NETWORKS
    from viewmend.metrics.weights import KNOWN, verified

    if not path.is_file():
        raise ValueError(f"{path}: expected a file of weights, found none; check the path")
    if name is None:
        by_name = [k.name for k in KNOWN if any(Path(file).name == path.name for file in k.files)]
        by_hash = [k.name for k in KNOWN if (k.sha256 or k.git_sha1) and verified(path, k)]
        if not by_name + by_hash:
            names = ", ".join(k.name for k in KNOWN)
            raise ValueError(
                f"{path}: expected known weights, got a file of another name and hash; give --name {names}"
            )
        name = (by_hash + by_name)[0]
    line = _line(name, path)
    return {**line, **_loaded(name, path)} if name in NETWORKS else line


def _loaded(name: str, path: Path) -> dict[str, str]:
    """What loading says of a published network's file, whose hash nobody published."""
    from viewmend.baselines.published import NETWORKS
    from viewmend.weight_files import WeightsError, load_weights

    try:
        load_weights(NETWORKS[name](), path)
    except WeightsError as error:
        return {"status": "wrong", "said": str(error)}
    return {"status": "right by all names and shapes"}


def _line(name: str, path: Path | None) -> dict[str, str]:
    from viewmend.metrics.weights import known_weights, stated_hashes, verify_weights
    from viewmend.weight_files import WeightsError

    known, status, said = known_weights(name), "missing", ""
    if path is not None:
        status = (
            "right" if known.sha256 or known.git_sha1 else "there (no hash was published; loading checks all shapes)"
        )
        try:
            verify_weights(path, known)
        except WeightsError as error:
            status, said = "wrong", str(error)
    return {
        "name": name,
        "status": status,
        "path": "" if path is None else str(path),
        "files": " or ".join(known.files),
        "what": known.what,
        "source": known.source,
        "licence": known.licence,
        "hash": stated_hashes(known),
        "said": said,
    }
