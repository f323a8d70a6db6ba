"""The numbers of `tables.toml`, which seeds vary."""

import tomllib
from importlib.resources import files
from typing import Any

TABLES: dict[str, Any] = tomllib.loads((files("viewmend.studio.procedural") / "tables.toml").read_text())
"""Name -> rows; the file's comments say what the columns are."""
