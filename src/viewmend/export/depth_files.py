"""Float depth as OpenEXR, with the package of that name (the extra `viewmend[engines]`)."""

from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from viewmend.atomic_writes import write_atomically


def demand_openexr() -> None:
    """See that depth can be written.

    Raises:
        ValueError: OpenEXR is not installed.
    """
    try:
        import OpenEXR  # noqa: F401
    except ImportError:
        raise ValueError(
            "expected the package OpenEXR, got none: float depth is written by it; install viewmend's extra 'engines'"
        ) from None


def write_exr_depth(path: Path, depth_m: Float[Tensor, "height width"]) -> None:
    """z-depth in metres as the channel Z of an OpenEXR file, 32-bit float, losslessly compressed; 0 stays 0.

    Raises:
        OSError: the file cannot be written.
    """
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {"Z": depth_m.float().contiguous().cpu().numpy()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda beside: OpenEXR.File(header, channels).write(str(beside)))
