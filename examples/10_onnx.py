"""Export the model to ONNX and run it without PyTorch's code: `python examples/10_onnx.py [OUT.onnx]`.

docs/guide/export.md describes the inputs. Here they come from a `Stream`; another renderer fills in the same arrays.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import onnxruntime

from viewmend import CachedFrame, IncompleteView, Stream, Studio, StudioConfig, load_inpainter, orbit


def inputs_of(view: IncompleteView, cached: CachedFrame, num_views: int) -> dict[str, np.ndarray]:
    """The arrays that an exported model takes for a rendered view; `num_views` cameras are sampled at most."""
    names = view.candidate_views
    frame = cached.frame.select(names)
    weights = dict(zip(view.source_views, view.weights, strict=True))
    tensors = {"rgb": view.rgb, "mask": view.mask, "error": view.error, "depth": view.depth}
    tensors |= {"K": view.camera.K[0], "camera_from_world": view.camera.camera_from_world[0]}
    tensors |= {"images": frame.rgb, "masks": frame.mask, "proxy_depths": cached.depth(names)}
    tensors |= {"rig_K": frame.cameras.K, "rig_camera_from_world": frame.cameras.camera_from_world}
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    chosen = names[:num_views]
    zero = np.zeros_like(arrays["mask"])
    arrays["weights"] = np.stack([weights[name].numpy() if name in weights else zero for name in chosen])
    arrays["chosen"] = np.arange(len(chosen))
    arrays["is_source"] = np.array([name in weights for name in chosen])
    arrays["image_sizes_px"] = frame.cameras.size_px.long().numpy()
    return arrays


def main(out: Path, model: str = "views", size_px: int = 256) -> float:
    """Export, complete a view with both, and return the mean difference of their colours."""
    command = [sys.executable, "-m", "viewmend", "export", model, "--format", "onnx", "--out", str(out)]
    subprocess.run(command, check=True)
    studio = Studio(StudioConfig(seed=10003, cameras=6, frames=1, size_px=size_px))
    stream = Stream(load_inpainter(model, precision="float32"), bounds=studio.bounds)
    cached = stream.add_frame(studio.read(0))
    view = stream.view(orbit([0.4], (size_px, size_px), elevation_rad=0.2)).completed.view

    session = onnxruntime.InferenceSession(out)
    wanted = {given.name for given in session.get_inputs()}
    num_views = len(stream.inpainter.source_names(view))
    arrays = inputs_of(view, cached, num_views)
    arrays = {name: array for name, array in arrays.items() if name in wanted}
    [completed_rgb] = session.run(["completed_rgb"], arrays)  # also alpha, confidence and completed_depth

    completed, _ = stream.inpainter.step(view, stream.context_provider(), stream.inpainter.initial_state())
    return float(np.abs(completed_rgb - completed.rgb.numpy()).mean())


if __name__ == "__main__":
    print(f"mean difference {main(Path(sys.argv[1] if len(sys.argv) > 1 else 'out/views.onnx')):.6f}")
