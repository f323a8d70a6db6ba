"""Real-time inpainting of free-viewpoint video.

`viewmend.__all__` lists the public names. Each is imported on first use, so that `import viewmend`
is instant. Importing the package also lets PyTorch's idle threads sleep (`utils/openmp.py`).
"""

from importlib import import_module
from typing import TYPE_CHECKING

from viewmend.utils.openmp import let_idle_threads_sleep

if TYPE_CHECKING:
    from viewmend.data.capture_folder import open_capture
    from viewmend.data.errors import CaptureError
    from viewmend.data.images import write_image
    from viewmend.data.native_writer import write_capture
    from viewmend.data.prepare import prepare
    from viewmend.frame_cache import CachedFrame, DepthProvider
    from viewmend.geometry.bounds import Bounds
    from viewmend.geometry.cameras import Cameras, pinhole
    from viewmend.geometry.fusion import FusionConfig
    from viewmend.geometry.hull import HullConfig
    from viewmend.geometry.rigid import look_at
    from viewmend.live.client import Client, Publisher
    from viewmend.live.viewer import Viewer, serve
    from viewmend.models.base import ContextProvider, Inpainter, RenderQuality, State
    from viewmend.models.checkpoint import load_inpainter
    from viewmend.models.registry import make_method
    from viewmend.rendering.error_mask import Evidence, error_rule
    from viewmend.rendering.view import RenderConfig
    from viewmend.stream import Stream, StreamConfig, StreamView
    from viewmend.studio.rigs import orbit
    from viewmend.studio.stage import Studio, StudioConfig
    from viewmend.types import CompletedView, ContextViews, IncompleteView, MultiViewFrame, Silhouettes
    from viewmend.utils.timing import StageTimes

__version__ = "0.1.0"

let_idle_threads_sleep()

__all__ = [
    "Bounds",
    "CachedFrame",
    "Cameras",
    "CaptureError",
    "Client",
    "CompletedView",
    "ContextProvider",
    "ContextViews",
    "DepthProvider",
    "Evidence",
    "FusionConfig",
    "HullConfig",
    "IncompleteView",
    "Inpainter",
    "MultiViewFrame",
    "Publisher",
    "RenderConfig",
    "RenderQuality",
    "Silhouettes",
    "StageTimes",
    "State",
    "Stream",
    "StreamConfig",
    "StreamView",
    "Studio",
    "StudioConfig",
    "Viewer",
    "__version__",
    "error_rule",
    "load_inpainter",
    "look_at",
    "make_method",
    "open_capture",
    "orbit",
    "pinhole",
    "prepare",
    "serve",
    "write_capture",
    "write_image",
]

_NAMES = {
    "data.errors": ("CaptureError",),
    "data.images": ("write_image",),
    "data.capture_folder": ("open_capture",),
    "data.native_writer": ("write_capture",),
    "data.prepare": ("prepare",),
    "frame_cache": ("CachedFrame", "DepthProvider"),
    "geometry.bounds": ("Bounds",),
    "geometry.cameras": ("Cameras", "pinhole"),
    "geometry.fusion": ("FusionConfig",),
    "geometry.hull": ("HullConfig",),
    "geometry.rigid": ("look_at",),
    "live.client": ("Client", "Publisher"),
    "live.viewer": ("Viewer", "serve"),
    "models.base": ("ContextProvider", "Inpainter", "RenderQuality", "State"),
    "models.checkpoint": ("load_inpainter",),
    "models.registry": ("make_method",),
    "rendering.error_mask": ("Evidence", "error_rule"),
    "rendering.view": ("RenderConfig",),
    "stream": ("Stream", "StreamConfig", "StreamView"),
    "studio.rigs": ("orbit",),
    "studio.stage": ("Studio", "StudioConfig"),
    "types": ("CompletedView", "ContextViews", "IncompleteView", "MultiViewFrame", "Silhouettes"),
    "utils.timing": ("StageTimes",),
}
_MODULES = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> object:
    """Import a public name on first use."""
    if name not in _MODULES:
        raise AttributeError(
            f"module 'viewmend' has no attribute '{name}'; viewmend.__all__ lists those that it has"
        )
    return getattr(import_module(f"viewmend.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    """The public names."""
    return __all__
