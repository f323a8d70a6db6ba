"""Makes the modules of benchmarks/ importable: `import benchmarks_path` before the first of them."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
