"""Makes the reference implementations of tests/reference importable: `import tests_path` before the first of them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests"))
