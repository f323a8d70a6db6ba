"""Plain English: archaic words and phrases do not come back."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
UNWANTED = re.compile(r"\b(upon|anew|nobody|somebody|so many|beside|told)\b", re.IGNORECASE)


def prose() -> list[Path]:
    """Sources with their page and model cards, and the documents; laboratory notes are dated and exempt."""
    kinds = {".py", ".js", ".html", ".css", ".md", ".toml"}
    found = [
        path
        for folder in ("src", "docs", "examples")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in kinds
    ]
    return sorted([*found, *ROOT.glob("*.md")])


def test_unwanted_words_do_not_occur():
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()}"
        for path in prose()
        for number, line in enumerate(path.read_text().splitlines(), 1)
        for _ in UNWANTED.finditer(line)
    ]
    assert found == [], "write it in plain English"


def test_unwanted_words_are_found():
    assert UNWANTED.findall("Beside a man who upon_white told nobody") == ["Beside", "told", "nobody"]
