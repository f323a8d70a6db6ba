"""Fills the holes of free-viewpoint video, live.

`viewmend.__all__` is what others may build on; each name is imported when it is asked for, so that
`import viewmend` alone stays instant.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viewmend.capture.errors import CaptureError
    from viewmend.capture.plain import open_capture
    from viewmend.capture.prepare import prepare
    from viewmend.geometry.bounds import Bounds
    from viewmend.geometry.cameras import Cameras, pinhole
    from viewmend.geometry.hull import HullConfig
    from viewmend.geometry.rigid import look_at
    from viewmend.inpainting.checkpoint import load_inpainter
    from viewmend.inpainting.protocol import ContextProvider, RenderQuality, State, ViewInpainter
    from viewmend.leave_one_out.riftcast_views import RiftcastViews
    from viewmend.live.client import Client
    from viewmend.live.publisher import Publisher
    from viewmend.methods import make_method
    from viewmend.observation import DepthProvider, Observation
    from viewmend.rendering.error_rules import Evidence, error_rule
    from viewmend.rendering.view import RenderConfig
    from viewmend.stream import Stream, StreamConfig, StreamView
    from viewmend.timing import StageTimes
    from viewmend.views import CompletedView, ContextViews, IncompleteView, MultiViewFrame, Silhouettes

__version__ = "0.1.0"

__all__ = [
    "Bounds",
    "Cameras",
    "CaptureError",
    "Client",
    "CompletedView",
    "ContextProvider",
    "ContextViews",
    "DepthProvider",
    "Evidence",
    "HullConfig",
    "IncompleteView",
    "MultiViewFrame",
    "Observation",
    "Publisher",
    "RenderConfig",
    "RenderQuality",
    "RiftcastViews",
    "Silhouettes",
    "StageTimes",
    "State",
    "Stream",
    "StreamConfig",
    "StreamView",
    "ViewInpainter",
    "__version__",
    "error_rule",
    "load_inpainter",
    "look_at",
    "make_method",
    "open_capture",
    "pinhole",
    "prepare",
]

_ROOM = {
    "Bounds": "geometry.bounds",
    "Cameras": "geometry.cameras",
    "CaptureError": "capture.errors",
    "Client": "live.client",
    "CompletedView": "views",
    "ContextProvider": "inpainting.protocol",
    "ContextViews": "views",
    "DepthProvider": "observation",
    "Evidence": "rendering.error_rules",
    "HullConfig": "geometry.hull",
    "IncompleteView": "views",
    "MultiViewFrame": "views",
    "Observation": "observation",
    "Publisher": "live.publisher",
    "RenderConfig": "rendering.view",
    "RenderQuality": "inpainting.protocol",
    "RiftcastViews": "leave_one_out.riftcast_views",
    "Silhouettes": "views",
    "StageTimes": "timing",
    "State": "inpainting.protocol",
    "Stream": "stream",
    "StreamConfig": "stream",
    "StreamView": "stream",
    "ViewInpainter": "inpainting.protocol",
    "error_rule": "rendering.error_rules",
    "load_inpainter": "inpainting.checkpoint",
    "look_at": "geometry.rigid",
    "make_method": "methods",
    "open_capture": "capture.plain",
    "pinhole": "geometry.cameras",
    "prepare": "capture.prepare",
}


def __getattr__(name: str) -> object:
    """The public name, from the room that defines it."""
    if name not in _ROOM:
        raise AttributeError(f"module 'viewmend' has no attribute '{name}'; viewmend.__all__ lists those that it has")
    return getattr(import_module(f"viewmend.{_ROOM[name]}"), name)


def __dir__() -> list[str]:
    """What `dir(viewmend)` shows."""
    return __all__
