"""What RIFTCast's exporter wrote: views of another renderer, each seen from where a camera of the rig is."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.data.errors import CaptureError
from viewmend.data.formats import riftcast
from viewmend.data.images import read_mask, read_rgb, to_mask
from viewmend.data.native_capture import open_capture
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.mesh import Mesh
from viewmend.geometry.rasterize import rasterize
from viewmend.rendering.view import select_closest
from viewmend.types import IncompleteView, Silhouettes

NEAR_M, FAR_M = 0.01, 1000.0
"""The planes between which the exporter's window depth is, 0 to 1; 1 is background."""
CHOSEN = "used_cameras.bin"
BYTES = {"f4": 4, "i4": 4, "i8": 8}


@dataclass(frozen=True)
class ExportedGeometry:
    """The exporter's hull: what `Stream.push` asks for depths."""

    mesh: Mesh

    def depth(self, cameras: Cameras) -> Float[Tensor, "view height width"]:
        """z-depth of the surface in each camera, metres; 0 where there is none."""
        return rasterize(self.mesh, cameras).depth


class RiftcastViews:
    """Reads an export folder as incomplete views with its geometry and camera images.

    `capture.read(time)` includes the camera at the pose of a view: exclude it from the inputs, and its
    image is the truth. The exporter's hull has seen that camera's mask: `--exclude_nearest` leaves out its colours
    alone.

    Examples:
        >>> from viewmend import CaptureError, RiftcastViews
        >>> try:
        ...     RiftcastViews("export", capture="nowhere")
        ... except CaptureError as error:
        ...     print("nowhere" in str(error))
        True
    """

    def __init__(self, folder: str | Path, capture: str | Path) -> None:
        """Open an export and the data set that it was made of.

        Args:
            folder: of the export: `frame_00000` and on, with `rgb`, `mask`, `error` and `depth`.
            capture: the data set's folder, or the meta file that the exporter was started with.

        Raises:
            CaptureError: there is no such export, or the data set cannot be read.
        """
        self.folder = Path(folder)
        self.capture = open_capture(Path(capture), format="riftcast")
        self._world = riftcast.stored_from_program(Path(capture))
        if not any(self.folder.glob("frame_*/error")):
            raise CaptureError(
                f"{folder}: expected an export with frame_00000/error, found none; run the exporter, with --inpaint "
                "false"
            )
        self._chosen = self._chosen_cameras()

    def geometry(self, time: int) -> ExportedGeometry:
        """The hull of a time, in the frame of `capture.cameras`.

        Raises:
            CaptureError: a file is missing or does not read.
        """
        folder = self._frame(time)
        vertices = self._numbers(folder / "vertices.bin", "f4", 3).astype(np.float64)
        faces = self._numbers(folder / "faces.bin", "i8", 3)
        if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
            raise CaptureError(f"{folder / 'faces.bin'}: expected corners among {len(vertices)} vertices, got others")
        moved = vertices @ self._world[:3, :3].T + self._world[:3, 3]
        return ExportedGeometry(Mesh(torch.from_numpy(moved).float(), torch.from_numpy(faces).int()))

    def view(self, time: int, name: str) -> IncompleteView:
        """What the exporter rendered where camera `name` is, at index `time` of `capture.frame_ids`.

        Which of the chosen cameras coloured a pixel it does not write: each counts the same.

        Raises:
            CaptureError: a file is missing, does not read or is of another size.
        """
        folder, frame = self._frame(time), self.capture.read(time)
        camera = self.capture.cameras.select([name])
        width, height = camera.max_size_px
        files = {kind: folder / f"{kind}/{kind}_{name}.png" for kind in ("rgb", "mask", "error")}
        rgb = read_rgb(files["rgb"], str(files["rgb"]))
        mask, error = (to_mask(read_mask(files[kind], str(files[kind]))) for kind in ("mask", "error"))
        depth = self._depth(folder / f"depth/depth_{name}.bin", width, height)
        for image in (rgb, mask, error):
            if image.shape[:2] != (height, width):
                got = f"{image.shape[1]} x {image.shape[0]}"
                raise CaptureError(f"{folder}: expected views of {width} x {height} of camera '{name}', got {got}")
        subject, missing = torch.from_numpy(mask > 127), torch.from_numpy(error > 127)
        coloured = subject & ~missing
        others = frame.without([name])
        candidates = select_closest(camera, others.cameras, self._middle(time), len(others.cameras))
        sources = self._chosen.get(int(self.capture.frame_ids[time]), {}).get(name, candidates[:3])
        colours = torch.from_numpy(rgb).movedim(-1, 0) / 255
        return IncompleteView(
            camera=camera,
            rgb=torch.where(coloured, colours, 0.0),
            mask=subject.float(),
            error=(subject & missing).float(),
            depth=torch.where(subject, depth, 0.0),
            source_views=sources,
            weights=(coloured / len(sources)).expand(len(sources), -1, -1).contiguous(),
            time=time,
            candidate_views=candidates,
            silhouettes=None if others.mask is None else Silhouettes(others.mask, others.cameras),
        )

    def _middle(self, time: int) -> Float[Tensor, "3"]:
        vertices = self.geometry(time).mesh.vertices
        return (vertices.amin(0) + vertices.amax(0)) / 2 if len(vertices) else torch.zeros(3)

    def _frame(self, time: int) -> Path:
        return self.folder / f"frame_{int(self.capture.frame_ids[time]):05d}"

    def _depth(self, file: Path, width: int, height: int) -> Float[Tensor, "height width"]:
        """z-depth of a file of window depths, whose first row is the lowest."""
        window = self._numbers(file, "f4", width)
        if len(window) != height:
            raise CaptureError(f"{file}: expected {height} rows of {width} depths, got {len(window)}; export it again")
        ndc = 2 * torch.from_numpy(window[::-1].astype(np.float64)) - 1
        z = 2 * NEAR_M * FAR_M / (FAR_M + NEAR_M - ndc * (FAR_M - NEAR_M))
        return torch.where(ndc < 1, z, 0.0).float()

    def _numbers(self, file: Path, kind: str, columns: int) -> np.ndarray:
        """A file of numbers without a head, in rows."""
        try:
            size = file.stat().st_size
            if size % (BYTES[kind] * columns):
                raise CaptureError(f"{file}: expected rows of {columns} numbers, got {size} bytes; export it again")
            return np.fromfile(file, f"<{kind}").reshape(-1, columns)
        except OSError as error:
            raise CaptureError(f"{file}: expected a file of the export ({error.strerror}); export it again") from None

    def _chosen_cameras(self) -> dict[int, dict[str, tuple[str, ...]]]:
        """The cameras that coloured each view, by frame and name; the exporter numbers them in the calibration's order.

        Frames beyond its table, and files that are not there, have none.
        """
        file, names = self.folder / CHOSEN, self.capture.cameras.names
        if not file.is_file():
            return {}
        rows = self._numbers(file, "i4", 3 * len(names)).reshape(-1, len(names), 3)
        if rows.size and not 0 <= rows.min() <= rows.max() < len(names):
            raise CaptureError(f"{file}: expected numbers of {len(names)} cameras, got others; is it of this data set?")
        # Views of their own camera, which the exporter lets slip in, are none of a camera left out.
        chosen = [
            [
                tuple(names[i] for i in dict.fromkeys(own) if names[i] != name)
                for name, own in zip(names, row, strict=True)
            ]
            for row in rows.tolist()
        ]
        return {n: {k: v for k, v in zip(names, row, strict=True) if v} for n, row in enumerate(chosen)}
