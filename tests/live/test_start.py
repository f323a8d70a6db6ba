"""What `viewmend serve` settles before anything heavy is loaded."""

import subprocess
import sys


def test_the_command_is_read_without_torch():
    """Its threads read their policy when it is loaded: `serve` must have set it by then."""
    code = "import sys; import viewmend.cli, viewmend.cli.serve; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
