"""docs/options.md gives every field of a config a figure, and knows no field that is not there."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs/options.md"
CONFIG = re.compile(r"\w*(Config|Quality|Sampling|Plan|LossWeights|Recipe)")
"""How the classes are named whose fields change what the system computes; a server's settings are in docs/live.md."""
NO_SWITCHES = {"ServerConfig", "StudioConfig"}
FIGURE, NONE = re.compile(r"\d"), re.compile(r"no figure|not measured|nobody measured|\byet\b")
COLUMNS = ["switch", "what it changes", "figure or reason", "page"]


def switches_of(src: Path) -> dict[str, list[str]]:
    """The fields of each config that have a default; one whose type is a config is no switch itself."""
    found = {}
    for path in sorted(src.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and CONFIG.fullmatch(node.name) and node.name not in NO_SWITCHES:
                fields = [f for f in node.body if isinstance(f, ast.AnnAssign) and f.value is not None]
                found[node.name] = [ast.unparse(f.target) for f in fields if not is_config(f.annotation)]
    return {name: fields for name, fields in found.items() if fields}


def is_config(annotation: ast.expr) -> bool:
    """Whether a field holds another config, annotated or not, or none where a base class has one."""
    return ast.unparse(annotation) == "None" or bool(
        CONFIG.fullmatch(ast.unparse(annotation).removeprefix("Annotated[").split(",")[0])
    )


def rows_of(page: str) -> dict[str, dict[str, list[str]]]:
    """The table under each heading: the other cells by the first."""
    tables = {}
    for part in re.split(r"^## ", page, flags=re.MULTILINE)[1:]:
        rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in part.splitlines() if line.startswith("|")]
        assert rows[0] == COLUMNS, f"expected the columns {COLUMNS}, got {rows[0]}"
        tables[part.splitlines()[0].strip()] = {row[0].strip("`"): row[1:] for row in rows[2:]}
    return tables


def faults(src: Path, page: Path) -> list[str]:
    """Switches without a row, rows without a switch, and rows that give no figure or no page."""
    switches, tables = switches_of(src), rows_of(page.read_text())
    named = {f"{config}.{field}" for config, fields in switches.items() for field in fields}
    written = {f"{config}.{field}": cells for config, rows in tables.items() for field, cells in rows.items()}
    found = [f"{name} has no row" for name in sorted(named - written.keys())]
    found += [f"{name} is no switch" for name in sorted(written.keys() - named)]
    for name, (does, reason, where) in written.items():
        links = re.findall(r"\]\(([^)#]+)", where)
        if not does or not FIGURE.search(reason) or NONE.search(reason):
            found.append(f"{name} has no figure")
        if not links or not all((page.parent / link).is_file() for link in links):
            found.append(f"{name} names no page that is there")
    return found


def test_every_switch_has_a_figure():
    assert len(switches_of(ROOT / "src")) > 5
    assert faults(ROOT / "src", PAGE) == [], "say in docs/options.md what speaks for it, or delete it"


GOOD = """
## FillConfig

| switch | what it changes | figure or reason | page |
| --- | --- | --- | --- |
| `depth` | how deep | 0.1 dB better | [results](options.md) |
"""


@pytest.mark.parametrize(
    ("page", "expected"),
    [
        (GOOD, []),
        (GOOD.replace("`depth`", "`width`"), ["FillConfig.depth has no row", "FillConfig.width is no switch"]),
        (GOOD.replace("0.1 dB better", ""), ["FillConfig.depth has no figure"]),
        (GOOD.replace("0.1 dB better", "trains the fill"), ["FillConfig.depth has no figure"]),
        (GOOD.replace("0.1 dB better", "3 for the paper's; no figure"), ["FillConfig.depth has no figure"]),
        (GOOD.replace("options.md", "gone.md"), ["FillConfig.depth names no page that is there"]),
        ("", ["FillConfig.depth has no row"]),
    ],
)
def test_faults_are_seen(tmp_path, page, expected):
    (tmp_path / "fill.py").write_text("class FillConfig:\n    blend: BlendConfig\n    depth: int = 3\n")
    (tmp_path / "options.md").write_text(page)
    assert faults(tmp_path, tmp_path / "options.md") == expected
