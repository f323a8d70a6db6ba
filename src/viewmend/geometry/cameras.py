"""Pinhole cameras in OpenCV axes: projection, unprojection, and changes of the image grid."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.rigid import invert_rigid, is_rotation
from viewmend.utils.tensors import OnDevice, check_tensor

FARTHEST = 1e3
"""Largest distance of cameras from the origin, relative to the extent of their rig or `NEAR_RIG_M`. At that
distance, 32-bit numbers move the image of a point by up to 0.8 pixels, if the focal length is 1500
pixels and the point is as far from the camera as the rig is wide."""

NEAR_RIG_M = 1.0
"""Rigs of a smaller extent count as this large, metres: their subject is not nearer because of it."""

ROUNDING = 1e-6
"""Entries of K and of the last row of poses that have to be 0 or 1 may differ from that by this much, the
one in the second row of K relative to fy: decompositions and products of matrices leave such remainders."""


@dataclass(frozen=True)
class Cameras(OnDevice):
    """Calibrated pinhole cameras (with skew, without distortion: captures are undistorted when read).

    Axes are OpenCV's: x right, y down, z forward. K is in pixels of an image whose top-left pixel
    has its centre at (0.5, 0.5). Lengths are metres. One camera is a `Cameras` of one view.

    Examples:
        >>> import torch
        >>> from viewmend import Cameras
        >>> K = torch.tensor([[[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]])
        >>> front = Cameras(("front",), K, camera_from_world=torch.eye(4)[None], size_px=torch.tensor([[640, 480]]))
        >>> front.resized(320, 240).K[0, 0]
        tensor([250.,   0., 160.])
    """

    keeps_host_copy = True
    names: tuple[str, ...]
    K: Float[Tensor, "view 3 3"]
    camera_from_world: Float[Tensor, "view 4 4"]
    size_px: Int[Tensor, "view 2"]
    """Width and height of each view's image. Stacks of images are padded at the right and bottom."""

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, views: int | slice | Sequence[int]) -> "Cameras":
        """The cameras at these positions; an int gives a `Cameras` of one view."""
        if isinstance(views, int):
            index = [range(len(self))[views]]
        elif isinstance(views, slice):
            index = range(len(self))[views]
        else:
            index = views
        names = tuple(self.names[view] for view in index)
        made = Cameras(
            names, *(_rows(field, index) for field in (self.K, self.camera_from_world, self.size_px))
        )
        return self._with_host(made, lambda host: host[views])

    def _with_host(self, made: "Cameras", change: "Callable[[Cameras], Cameras]") -> "Cameras":
        """`made` of these cameras, with the copy on the CPU changed in the same way if they are on another device."""
        if self.K.device.type != "cpu":
            vars(made)["_host"] = change(self.on_host)
        return made

    def check(self) -> None:
        """ValueError unless names differ, and K, poses and sizes are tensors of the fields' types, one per name.

        Each K has to be an upper triangular matrix with the last row 0 0 1, and each pose a rigid motion.
        """
        count = len(self.names)
        if not count:
            raise ValueError("expected at least one camera, got none; name the cameras")
        twice = sorted({name for name in self.names if self.names.count(name) > 1})
        if twice:
            raise ValueError(
                f"expected a different name for each camera, got several cameras {twice}; rename them"
            )
        check_tensor(
            "K",
            self.K,
            (torch.float32,),
            (count, 3, 3),
            convert="convert it with .float()",
            arrange="give one 3 x 3 matrix per camera",
        )
        check_tensor(
            "camera_from_world",
            self.camera_from_world,
            (torch.float32,),
            (count, 4, 4),
            convert="convert it with .float()",
            arrange="give one pose per camera, with the last row 0 0 0 1",
        )
        check_tensor(
            "size_px",
            self.size_px,
            (torch.int64, torch.int32),
            (count, 2),
            convert="convert it with .long()",
            arrange="give width and height of each camera",
        )

        self._check_form()
        self._check_distance()

    def _check_form(self) -> None:
        """ValueError unless each K is one of a pinhole camera, and each pose a rotation and a translation."""
        host = self.on_host
        poses = host.camera_from_world.detach()
        turns = is_rotation(poses[:, :3, :3])
        for name, K, pose, turn in zip(
            self.names, host.K.tolist(), poses.tolist(), turns.tolist(), strict=True
        ):
            if not is_intrinsics(K):
                raise ValueError(
                    f"camera '{name}': expected K as [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0, "
                    f"got {K}; convert it to OpenCV's convention, in pixels"
                )
            *upper, last = pose
            is_shift = all(math.isfinite(shift) for *_, shift in upper)
            if not turn or not is_shift or math.dist(last, (0, 0, 0, 1)) > ROUNDING:
                raise ValueError(
                    f"camera '{name}': expected camera_from_world as a rotation and a translation, with the last row "
                    f"0 0 0 1, got {pose}; divide the rotation by any scale, and check axes and signs"
                )

    def _check_distance(self) -> None:
        """ValueError if the cameras are so far from the world's origin that 32-bit poses are too coarse."""
        centers = self.on_host.centers.detach()
        extent_m = float((centers.amax(0) - centers.amin(0)).amax())
        away_m = float(centers.abs().amax())
        if extent_m > 0 and away_m > FARTHEST * max(extent_m, NEAR_RIG_M):
            raise ValueError(
                f"expected cameras near the world's origin, got a rig of {extent_m:.3g} m that is {away_m:.3g} m away "
                "from it, where 32-bit numbers are too coarse; subtract the rig's centre from all positions, in 64 bits"
            )

    def check_single(self) -> None:
        """ValueError unless this is one camera that passes `check`."""
        self.check()
        if len(self) != 1:
            raise ValueError(
                f"expected the camera of one view, got {len(self)}; choose one, as in cameras[0]"
            )

    def select(self, names: Sequence[str]) -> "Cameras":
        """The cameras of these names, in this order.

        Raises:
            ValueError: a name is not among `names`, or a string is given instead of a list.
        """
        check_names("names", names)
        unknown = [n for n in names if n not in self.names]
        if unknown:
            raise ValueError(f"expected cameras among {list(self.names)}, got {unknown}; check the spelling")
        return self[[self.names.index(n) for n in names]]

    @cached_property
    def world_from_camera(self) -> Float[Tensor, "view 4 4"]:
        """Inverse of `camera_from_world`; for another device it is computed on the CPU."""
        if self.K.device.type != "cpu":
            return self.on_host.world_from_camera.to(self.K.device)
        with torch.inference_mode(False):  # the result may be used with gradients later
            return invert_rigid(self.camera_from_world)

    @cached_property
    def camera_from_pixel(self) -> Float[Tensor, "view 3 3"]:
        """Inverse of K: from homogeneous pixel coordinates to rays of z = 1 in the camera's axes."""
        if self.K.device.type != "cpu":
            return self.on_host.camera_from_pixel.to(self.K.device)
        with torch.inference_mode(False):
            return torch.linalg.inv_ex(self.K).inverse

    @cached_property
    def world_from_pixel(self) -> Float[Tensor, "view 3 3"]:
        """R K^-1: turns homogeneous pixel coordinates into rays of z = 1 in the camera's axes, in world axes."""
        if self.K.device.type != "cpu":
            return self.on_host.world_from_pixel.to(self.K.device)
        with torch.inference_mode(False):
            rotation = self.world_from_camera[:, :3, :3].double()
            return (rotation @ torch.linalg.inv_ex(self.K.double()).inverse).to(self.K)

    @property
    def centers(self) -> Float[Tensor, "view 3"]:
        """Camera centres in world coordinates, metres."""
        return self.world_from_camera[:, :3, 3]

    @cached_property
    def projection(self) -> Float[Tensor, "view 3 4"]:
        """K [R | t] in double precision: (u z, v z, z) of homogeneous world points; computed on the CPU."""
        host = self.on_host
        return (host.K.double() @ host.camera_from_world[:, :3].double()).to(self.K.device)

    @property
    def max_size_px(self) -> tuple[int, int]:
        """Width and height that hold every view."""
        width, height = self.on_host.size_px.amax(0).tolist()
        return int(width), int(height)

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Width and height of each view's image, pixels, as Python numbers."""
        return [(width, height) for width, height in self.on_host.size_px.tolist()]

    def resized(self, width: int, height: int) -> "Cameras":
        """Cameras whose images are resampled to width x height pixels (field of view unchanged)."""
        scale = torch.tensor([width, height], device=self.K.device) / self.size_px
        K = self.K.clone()
        K[:, :2] *= scale[:, :, None].to(K)
        size = torch.tensor([width, height], device=K.device).expand(len(self), 2).contiguous()
        return self._with_host(replace(self, K=K, size_px=size), lambda host: host.resized(width, height))

    def moved(self, x_px: float, y_px: float) -> "Cameras":
        """Cameras whose principal points are moved by (x, y) pixels."""
        K = self.K.clone()
        K[:, :2, 2] += torch.tensor([x_px, y_px]).to(K)
        return self._with_host(replace(self, K=K), lambda host: host.moved(x_px, y_px))

    def cropped(self, left: int, top: int, width: int, height: int) -> "Cameras":
        """Cameras that see the window at (left, top) of size width x height, in pixels; it may leave the image.

        Args:
            left: the window's first column in the image; below 0 it begins outside.
            top: its first row.
            width: its width.
            height: its height.
        """
        K = self.K.clone()
        K[:, 0, 2] -= left
        K[:, 1, 2] -= top
        size = torch.tensor([width, height], device=K.device).expand(len(self), 2).contiguous()
        made = replace(self, K=K, size_px=size)
        return self._with_host(made, lambda host: host.cropped(left, top, width, height))


def _rows(values: Tensor, index: Sequence[int]) -> Tensor:
    """These rows of a tensor, without making an index on its device; neighbours are not copied."""
    first = index[0] if len(index) else 0
    if list(index) == list(range(first, first + len(index))):
        return values[first : first + len(index)]
    return torch.stack([values[row] for row in index])


def check_names(what: str, names: Sequence[str]) -> None:
    """ValueError if these are a string, not a list of names: each of its letters would be taken as one."""
    if isinstance(names, str):
        raise ValueError(f"expected {what} as a list of names, got the string '{names}'; write ['{names}']")


def is_intrinsics(K: Sequence[Sequence[float]]) -> bool:
    """Whether K is [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], but for rounding, with fx and fy above 0."""
    (fx, skew, cx), (zero, fy, cy), last = K
    is_finite = all(map(math.isfinite, (fx, skew, cx, fy, cy)))
    is_upper = abs(zero) <= ROUNDING * fy and math.dist(last, (0, 0, 1)) <= ROUNDING
    return is_finite and is_upper and fx > 0 and fy > 0


def concatenate_cameras(parts: Sequence[Cameras]) -> Cameras:
    """All cameras of `parts`, in order."""
    made = Cameras(
        tuple(name for part in parts for name in part.names),
        torch.cat([part.K for part in parts]),
        torch.cat([part.camera_from_world for part in parts]),
        torch.cat([part.size_px for part in parts]),
    )
    if made.K.device.type != "cpu":
        vars(made)["_host"] = concatenate_cameras([part.on_host for part in parts])
    return made


def project(
    points_world: Float[Tensor, "point 3"], cameras: Cameras
) -> tuple[Float[Tensor, "view point 2"], Float[Tensor, "view point"]]:
    """Pixel coordinates and z-depth (metres) of world points in every camera.

    A point behind a camera has z <= 0; its pixel coordinates are meaningless (but finite): test z.
    """
    P = cameras.K @ cameras.camera_from_world[:, :3]
    homogeneous = torch.baddbmm(P[:, None, :, 3], points_world.expand(len(P), -1, -1), P[:, :, :3].mT)
    z = homogeneous[..., 2]
    return homogeneous[..., :2] / z.clamp_min(1e-9)[..., None], z


def unproject(
    uv_px: Float[Tensor, "view point 2"], z_m: Float[Tensor, "view point"], cameras: Cameras
) -> Float[Tensor, "view point 3"]:
    """World points at these pixels and z-depths, each in its own camera; inverse of `project`."""
    rays = F.pad(uv_px, (0, 1), value=1.0) @ cameras.world_from_pixel.mT
    return torch.addcmul(cameras.centers[:, None], rays, z_m[..., None])


def pixel_centers(
    width: int, height: int, device: torch.device | str = "cpu"
) -> Float[Tensor, "height width 2"]:
    """Image coordinates of every pixel's centre: (0.5, 0.5) at the top left."""
    u = torch.arange(0.5, width, device=device)
    v = torch.arange(0.5, height, device=device)
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)


def pinhole(
    fov_y_rad: float, width: int, height: int, camera_from_world: Float[Tensor, "4 4"], name: str = "view"
) -> Cameras:
    """One camera with square pixels, its principal point in the middle, and this vertical field of view.

    Args:
        fov_y_rad: angle between the image's top and bottom, radians.
        width: of the image, pixels.
        height: of the image, pixels.
        camera_from_world: the pose (OpenCV axes), metres; `look_at` makes one.
        name: what the camera is called.

    Raises:
        ValueError: the angle is not between 0 and pi, as one in degrees.

    Examples:
        >>> import torch
        >>> from viewmend import pinhole
        >>> pinhole(1.5708, 640, 480, torch.eye(4)).K[0].round()
        tensor([[240.,   0., 320.],
                [  0., 240., 240.],
                [  0.,   0.,   1.]])
    """
    if not 0 < fov_y_rad < math.pi:
        raise ValueError(
            f"expected a field of view between 0 and pi radians, got {fov_y_rad}; convert degrees to radians"
        )
    f = 0.5 * height / float(torch.tan(torch.tensor(fov_y_rad / 2)))
    K = torch.tensor([[f, 0.0, width / 2], [0.0, f, height / 2], [0.0, 0.0, 1.0]])
    cameras = Cameras((name,), K[None], camera_from_world[None], torch.tensor([[width, height]]))
    return cameras.to(camera_from_world.device)
