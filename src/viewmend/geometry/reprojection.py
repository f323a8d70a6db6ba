"""Carrying image points from one camera to another through the geometry: C_G of section 5."""

from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras, project, unproject


def carry(
    uv_px: Float[Tensor, "view point 2"], z_m: Float[Tensor, "view point"], sources: Cameras, target: Cameras
) -> tuple[Float[Tensor, "view point 2"], Float[Tensor, "view point"]]:
    """Where the surface points seen at `uv_px`, at depth `z_m`, of each source camera appear in the target camera.

    Args:
        uv_px: pixel coordinates, each in its own source camera.
        z_m: z-depth there, metres; of the geometry of the points' own time or of the current one.
        sources: one camera for each leading index.
        target: one camera.

    Returns:
        Pixel coordinates in the target (divide by `target.size_px` for screen coordinates in [0, 1]; outside is
        allowed) and z-depth there, <= 0 for what is behind it: its coordinates are meaningless.
    """
    world = unproject(uv_px, z_m, sources)
    carried, z_target = project(world.reshape(-1, 3), target)
    return carried[0].view_as(uv_px), z_target[0].view_as(z_m)
