"""What tests of live rigs share."""

from pathlib import Path

import pytest
from reference.ball_rig import make_rig


@pytest.fixture(scope="session")
def ball_rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a rig; leave it as it is."""
    pytest.importorskip("av")
    return make_rig(tmp_path_factory.mktemp("rig")).parent
