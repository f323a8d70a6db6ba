"""Marks for fields of dataclasses that are options of a command (tyro)."""

import tyro

FLAT = tyro.conf.arg(name="")
"""Marks a nested config whose fields are options without a prefix."""
NEGATED = tyro.conf.arg(help_behavior_hint="")
"""Marks a field that is true unless --no-NAME is given: its help describes that flag, not the
field's default."""
HIDDEN = tyro.conf.Suppress
"""Marks a field that a recipe sets and the command line does not offer."""
