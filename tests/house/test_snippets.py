"""Pages that show a file show it: a formatter once took the line that names it for Python."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_snippet_of_the_documents_names_a_file_that_is_there():
    lines = [(page, line) for page in ROOT.glob("docs/**/*.md") for line in page.read_text().splitlines()]
    named = [(page.name, re.fullmatch(r'--8<-- "([\w./]+)"', line), line) for page, line in lines if line[:3] == "--8"]
    assert len(named) >= 2
    assert not [(page, line) for page, found, line in named if found is None or not (ROOT / found[1]).is_file()]
