"""The documents name files, functions, commands and options that exist, and stay short."""

import ast
import importlib.util
import re
import shlex
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), ROOT / "research/README.md"])
NOTES = sorted((ROOT / "research/notes").rglob("*.md"))
MAX_LINE = 120
MAX_WORDS = 29_000
MAX_README_WORDS = 900
NAMED = re.compile(r"`([\w/]+\.py)(?:: (\w+))?`(?: \| `(.+)` \|$)?", re.MULTILINE)
"""A file, a name in it, and in the paper map's table of equations one line of that, or two."""
BLOCK = re.compile(r"^ *``` *\{? *\.?(sh|python)\b.*?$(.*?)^ *```", re.MULTILINE | re.DOTALL)
HAS_RECIPES = ("train", "make-dataset")


@cache
def sources(path: Path) -> dict[str, str]:
    """The source of the functions, classes and methods of a file by name; those of one name, one after the other."""
    found = dict[str, str]()
    text = path.read_text()
    lines = text.splitlines()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            own = "\n".join(lines[node.lineno - 1 : node.end_lineno])
            found[node.name] = f"{found.get(node.name, '')}\n{own}"
    return found


def contains(source: str, part: str) -> bool:
    """Whether a line of the source contains this, and the expression ends there."""
    ends = (line.partition(part)[2].lstrip() for line in source.splitlines() if part in line)
    return any(not end.startswith(("+", "-")) for end in ends)


def missing_names(text: str) -> list[str]:
    """The files, functions and lines that a page names and that do not exist."""
    found = []
    for file, name, line in NAMED.findall(text):
        paths = [p for p in (ROOT / "src/viewmend" / file, ROOT / file) if p.is_file()]
        inside = sources(paths[0]) if paths and name else {}
        lines = line.split("`, `") if line else []
        if (
            not paths
            or (name and name not in inside)
            or not all(contains(inside.get(name, ""), part) for part in lines)
        ):
            found.append(f"{file}: {name}")
    return found


def test_files_and_functions_exist():
    assert {
        p.name: m for p in PAGES if p.name != "CHANGELOG.md" and (m := missing_names(p.read_text()))
    } == {}
    rows = [r for r in (ROOT / "docs/paper-map.md").read_text().splitlines() if re.match(r"\| \d+ \| \d", r)]
    assert len(rows) == 28 and all(any(line for _, _, line in NAMED.findall(row)) for row in rows)


def test_a_missing_file_function_or_line_is_found():
    row = "`models/paper/tokenizer.py: blend` | `mended = error` |"
    assert missing_names("`stream.py: Stream`") == []
    assert missing_names("`stream.py: Strom`, `nowhere.py`") == ["stream.py: Strom", "nowhere.py: "]
    assert missing_names(row.replace("mended = error", "no such line")) == [
        "models/paper/tokenizer.py: blend"
    ]


def test_links_lead_to_files():
    broken = [
        f"{page.relative_to(ROOT)}: {link}"
        for page in [*PAGES, *NOTES]
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text())
        if not (page.parent / link).exists() and link != "options.md"
    ]
    assert broken == []


def test_documents_are_short():
    words = {page: len(page.read_text().split()) for page in PAGES}
    assert sum(words.values()) <= MAX_WORDS and words[ROOT / "README.md"] <= MAX_README_WORDS
    long = [
        f"{p.name}: {line}"
        for p in PAGES
        for line in p.read_text().splitlines()
        if len(line) > MAX_LINE and "|" not in line
    ]
    assert long == []


@cache
def options_of(*words: str) -> set[str]:
    """The options of a command, as its help lists them."""
    spec = importlib.util.spec_from_file_location("generate_options", ROOT / "docs/generate_options.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return {name for name, _, _ in module.options(module.help_of(*words))}


def unknown_options(command: str) -> list[str]:
    """The options of a command line that the command does not have."""
    from viewmend.cli import COMMANDS

    words = [word.split("=")[0] for word in shlex.split(command, comments=True)]
    names = set(COMMANDS)
    length = next((n for n in (2, 1) if " ".join(words[:n]) in names), 0)
    if not length:
        return words[:1]
    recipe = [word for word in words[length : length + 1] if words[0] in HAS_RECIPES and word.islower()]
    known = options_of(*words[:length], *recipe)
    return [word for word in words[length:] if word.startswith("--") and word not in known]


def commands(text: str) -> list[str]:
    """The viewmend command lines of a page: in blocks, and in backticks where they have an option or an argument."""
    blocks = "\n".join(body for kind, body in BLOCK.findall(text) if kind == "sh").replace("\\\n", " ")
    lines = re.findall(r"(?:^|/| )viewmend ([a-z].*?)(?= && |$)", blocks, re.MULTILINE)
    return lines + re.findall(r"(?<!`)`viewmend ([a-z][^`\n]* [^`\n]+)`", text)


def test_commands_and_options_exist():
    found = {
        f"{p.name}: {c}": bad
        for p in PAGES
        if p.name != "CHANGELOG.md"
        for c in commands(p.read_text())
        if (bad := unknown_options(c))
    }
    assert found == {}


def test_python_blocks_import_what_exists():
    for page in PAGES:
        for kind, body in BLOCK.findall(page.read_text()):
            lines = [
                line.strip() for line in body.splitlines() if re.match(r" *(from|import) viewmend", line)
            ]
            if kind == "python" and lines:
                exec("\n".join(lines), {})
