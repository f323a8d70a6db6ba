"""The shipped `paper-small` with less context, as methods of `viewmend evaluate`.

    viewmend evaluate R48 --performers PERFORMERS --protocol target-mask --score-background white --out OUT \
      --methods paper-small,research/less_context.py:present,research/less_context.py:one_camera

They share the rendered views and the encoded cameras of a run. `--top-k` changes how many tokens are kept.
"""

from dataclasses import replace

from viewmend.models.checkpoint import load_network
from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.patch_transformer import PatchTransformer
from viewmend.types import IncompleteView


class NoCameras(PatchTransformer):
    """Completes a view from its own patches."""

    def source_names(self, view: IncompleteView) -> tuple[str, ...]:
        """No camera."""
        return ()


def present() -> PatchTransformer:
    """The three closest cameras in the view's own frame."""
    return _with(PatchTransformer, replace(_shipped().config, n_c=0, n_w=0))


def one_camera() -> PatchTransformer:
    """The closest camera in all frames of the window."""
    return _with(PatchTransformer, replace(_shipped().config, num_source_views=1))


def no_cameras() -> PatchTransformer:
    """No camera image: only the view's own complete patches."""
    return _with(NoCameras, _shipped().config)


def _shipped() -> PatchTransformer:
    model = load_network("paper-small")
    assert isinstance(model, PatchTransformer)
    return model


def _with(kind: type[PatchTransformer], config: PaperConfig) -> PatchTransformer:
    """The shipped weights in a model of another kind or config."""
    model = kind(config)
    model.load_state_dict(_shipped().state_dict())
    return model.eval()
