"""The page options.md, generated from the commands' own help. `python docs/generate_options.py` prints it.

mkdocs calls `on_files` (mkdocs.yml, `hooks`), so the page is never out of date and is not stored in the repository.
"""

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "src"))

WITH_RECIPES = {
    "train": ("views", "rays", "paper", "paper-small", "dstt"),
    "make-dataset": ("views", "rays", "paper"),
}
"""Commands whose options depend on their first word, and the words to show; dstt stands for all published networks."""
OPTION = re.compile(r"  (--\w[\w.-]*|[A-Z]\S*)(?: (\S.*?))?(?:  +(\S.*))?")


def help_of(*words: str) -> str:
    """What `viewmend WORDS --help` prints, in one column."""
    from viewmend import cli

    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), patch.dict(os.environ, {"COLUMNS": "79", "NO_COLOR": "1"}):
        code = cli.main([*words, "--help"])
    if code:
        raise ValueError(f"expected the help of viewmend {' '.join(words)}, got exit code {code}")
    return printed.getvalue()


def options(text: str) -> Iterator[tuple[str, str, str]]:
    """Name, value and description of each option in a help text."""
    found: list[tuple[str, str, str]] = []
    for line in text.splitlines():
        if match := OPTION.fullmatch(line.rstrip()):
            found.append((match[1], (match[2] or "").removeprefix("{None}|"), match[3] or ""))
        elif found and line.startswith(8 * " "):
            name, value, said = found.pop()
            found.append((name, value, f"{said} {line.strip()}".strip()))
    yield from found


def section(*words: str) -> str:
    """One command: its description and a list of its options."""
    text = help_of(*words)
    about = re.split(r"\n (?:positional arguments|options) *\n", text)[0].strip().split("\n\n", 1)[1:]
    rows = [f"* `{f'{name} {value}'.strip()}`: {said}" for name, value, said in options(text)]
    return "\n\n".join([f"## {' '.join(words)}", *about, "\n".join(rows)])


def page() -> str:
    """Every command with its options."""
    from viewmend.cli import COMMANDS

    parts = ["# Command-line options", "Generated from the help of each command."]
    for command in COMMANDS:
        words = command.split()
        parts += [section(*words, *recipe.split()) for recipe in WITH_RECIPES.get(command, ("",))]
    return "\n\n".join(parts) + "\n"


def on_files(files: Any, config: Any) -> Any:
    """Add the page to the site."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "options.md", content=page()))
    return files


if __name__ == "__main__":
    print(page())
