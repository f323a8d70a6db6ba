"""Write what an exported model takes, of one view of a studio scene: `python examples/cpp/write_view.py OUT`.

A renderer of your own fills in the same tensors; docs/guide/export.md says what each is.
"""

import sys
from pathlib import Path

from viewmend import Stream, StreamConfig, load_inpainter
from viewmend.export.traceable import ViewInputs
from viewmend.models.base import ContextProvider
from viewmend.studio.rigs import orbit
from viewmend.studio.stage import Studio, StudioConfig
from viewmend.utils.atomic_writes import write_tensors


def studio_view(seed: int = 10003, cameras: int = 8, size: int = 256) -> ViewInputs:
    """A view between the cameras of a procedural scene, rendered as `viewmend mend` does, and the rig."""
    frame = Studio(StudioConfig(seed=seed, cameras=cameras, frames=1, size_px=size)).read(0)
    net = load_inpainter("views", precision="float32")
    stream = Stream(net, StreamConfig())
    seen = stream.add_frame(frame)
    view = stream.render(orbit([0.4], (size, size), elevation_rad=0.2))
    return ViewInputs.of(view, ContextProvider(lambda _, names: seen.context(names)), num_views=8)


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/view.safetensors")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_tensors(out, studio_view()._asdict(), {})
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
