"""`python -m viewmend.cli` is `viewmend`."""

import sys

from viewmend.cli import main

sys.exit(main())
