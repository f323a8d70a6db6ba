"""Runs the `viewmend` command: `python -m viewmend.cli`."""

import sys

from viewmend.cli import main

sys.exit(main())
