"""Pushing a rig's frames to `viewmend serve live` (needs `viewmend[live]`)."""

import json
from typing import Any

import cv2
import numpy as np
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.live.client import ServerSocket
from viewmend.live.poses import bounds_json, cameras_json
from viewmend.live.protocol import VERSION, pack
from viewmend.views import MultiViewFrame


class Publisher:
    """A rig's connection; a context manager. Frames are undistorted, with masks.

    Raises:
        ConnectionError: the server refuses; says why.

    Examples:
        >>> from viewmend import Publisher
        >>> with Publisher(frame.cameras, "ws://127.0.0.1:8008", fps=15.0) as rig:  # doctest: +SKIP
        ...     rig.push(frame)
    """

    def __init__(
        self,
        cameras: Cameras,
        url: str = "ws://127.0.0.1:8008",
        token: str | None = None,
        fps: float = 15.0,
        name: str = "live rig",
        up: Tensor | None = None,
        bounds: Bounds | None = None,
    ) -> None:
        """Connect.

        Args:
            cameras: the rig, calibrated in metres.
            url: of the server, without a path.
            token: what `viewmend serve` was given, or said.
            fps: frames that will come a second.
            name: what the page calls the rig.
            up: the world's up, shape (3,); None to find it from the cameras.
            bounds: the volume that may hold the subject; None to find it from the masks.
        """
        self._socket = ServerSocket(f"{url}/push", token)
        self._rig = {
            "type": "rig",
            "version": VERSION,
            "name": name,
            "fps": fps,
            "up": None if up is None else up.tolist(),
            "bounds": None if bounds is None else bounds_json(bounds),
        }
        self.change(cameras)

    def __enter__(self) -> "Publisher":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def change(self, cameras: Cameras) -> None:
        """Be a rig of these cameras from now on: some came, went or were moved."""
        self._ask(json.dumps(self._rig | {"cameras": cameras_json(cameras)}))

    def push(self, frame: MultiViewFrame, quality: int = 92) -> int:
        """Send what the cameras see now; the number that it gets. Waits until the server has it.

        Raises:
            ValueError: the frame has no masks.
        """
        if frame.mask is None:
            raise ValueError("expected a frame with masks, got one without; make them (viewmend masks)")
        images: list[dict[str, Any]] = []
        parts: list[bytes] = []
        for view, name in enumerate(frame.cameras.names):
            width, height = frame.cameras.size_px[view].tolist()
            rgb = frame.rgb[view, :, :height, :width].movedim(0, -1).cpu().numpy()
            bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
            mask = frame.mask[view, :height, :width].cpu().numpy()
            for kind, data in (("rgb", _encoded(".jpg", bgr, quality)), ("mask", _encoded(".png", mask, quality))):
                images.append({"camera": name, "kind": kind, "bytes": len(data)})
                parts.append(data)
        return self._ask(pack({"images": images}, parts))["frame"]

    def _ask(self, message: str | bytes) -> dict[str, Any]:
        self._socket.send(message)
        answer = self._socket.receive(timeout_s=30.0)
        assert isinstance(answer, dict), "rigs are answered in JSON"
        return answer


def _encoded(suffix: str, image: np.ndarray, quality: int) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 1]
    return cv2.imencode(suffix, image, options)[1].tobytes()
