"""`viewmend splits`: a citable file of train/test splits with one held-out camera per scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Write a subject-disjoint train/test split with one held-out camera per scene.

    `viewmend evaluate OUT` runs the test scenes. The split follows from the captures' names and the
    seed: the same data and file give the same scenes everywhere.
    """

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE...")]
    """Captures of any supported format."""
    out: Path
    """The JSON file; paths of captures in it are relative to its folder."""
    subject: str = "(.*)"
    """Regular expression whose first group in a capture's name is the subject: '^(.*)_' for
    DNA-Rendering's 0012_11. By default, each capture is a subject of its own."""
    test_fraction: float = 7 / 79
    """Fraction of the scenes for tests, at least; by default the paper's, 7 of 79."""
    scenes: int | None = None
    """Use only this many of the captures, drawn at random by the seed; all by default. The paper has 79."""
    seed: int = 0
    """Seed of the choice of subjects and cameras."""
    format: str | None = None
    """Format of the captures (docs/formats.md); recognised by default."""


def run(options: Options) -> int:
    """Run the command; the exit code."""
    import re

    from viewmend.cli.checks import check_least
    from viewmend.cli.console import say, show
    from viewmend.scenes.capture_scenes import make_splits, splits_json
    from viewmend.utils.atomic_writes import remove_partial_file, write_text

    try:
        re.compile(options.subject)
    except re.error as error:
        raise ValueError(
            f"expected a regular expression for --subject, got '{options.subject}': {error}"
        ) from None
    if not 0 < options.test_fraction < 1:
        raise ValueError(
            f"expected --test-fraction between 0 and 1, got {options.test_fraction}; the paper has 7 of 79"
        )
    check_least(options, scenes=2)
    remove_partial_file(options.out)
    how = {name: getattr(options, name) for name in ("seed", "test_fraction", "scenes", "subject", "format")}
    splits = make_splits(options.captures, options.out.parent, **how)
    text = splits_json(splits)
    if options.out.exists() and options.out.read_text("utf-8", "replace") != text:
        raise ValueError(
            f"{options.out}: expected no such file, or the same splits, got others; published splits must not change: "
            "choose another --out"
        )
    write_text(options.out, text)
    for split in ("training", "test"):
        own = [scene for scene in splits.scenes if scene.split == split]
        show(f"{split}: {len(own)} scenes of {len({scene.subject for scene in own})} subjects")
    say(f"wrote {options.out}")
    return 0
