"""`viewmend splits`: the paper's protocol for captures, as a file that others can cite and `evaluate` takes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write who trains and who tests, subjects apart, and the camera that each scene leaves out.

    `viewmend evaluate OUT` runs the scenes for tests. Everything follows from names and the seed: whoever has the data
    and the file has the same scenes.
    """

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE...")]
    """Captures of any format that is read."""
    out: Path
    """The JSON file; the captures' paths in it are relative to its folder."""
    subject: str = "(.*)"
    """Whose capture it is: a regular expression, whose first group in the capture's name is the subject. By default
    every capture is somebody else's; '^(.*)_' for DNA-Rendering's 0012_11."""
    test_fraction: float = 0.1
    """At least this part of the scenes is for tests."""
    seed: int = 0
    """Chooses subjects and cameras."""
    kind: str | None = None
    """The captures' format, as docs/formats.md names it; by default it is recognised."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    import re

    from viewmend.atomic_writes import remove_half_of, write_text
    from viewmend.cli.console import say, show
    from viewmend.leave_one_out.capture_splits import make_splits, splits_json

    try:
        re.compile(options.subject)
    except re.error as error:
        raise ValueError(f"expected a regular expression for --subject, got '{options.subject}': {error}") from None
    if not 0 < options.test_fraction < 1:
        raise ValueError(
            f"expected --test-fraction above 0 and below 1, got {options.test_fraction}; the paper has 7 of 79"
        )
    remove_half_of(options.out)
    splits = make_splits(
        options.captures,
        options.out.parent,
        seed=options.seed,
        test_fraction=options.test_fraction,
        subject=options.subject,
        kind=options.kind,
    )
    text = splits_json(splits)
    if options.out.exists() and options.out.read_text("utf-8", "replace") != text:
        raise ValueError(
            f"{options.out}: expected no such file, or the same splits, got others; splits that were cited must not "
            "change: choose another --out"
        )
    write_text(options.out, text)
    for split in ("training", "test"):
        own = [scene for scene in splits.scenes if scene.split == split]
        show(f"{split}: {len(own)} scenes of {len({scene.subject for scene in own})} subjects")
    say(f"wrote {options.out}")
    return 0
