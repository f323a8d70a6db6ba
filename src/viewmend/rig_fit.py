"""What is learned of a rig before the first view: some of its cameras are left out in turn, and looked through."""

from dataclasses import replace

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy
from viewmend.inpainting.protocol import (
    ContextProvider,
    FitsRig,
    HeldOut,
    RenderQuality,
    ViewInpainter,
    crop_margin_px,
    own_error_rule,
)
from viewmend.observation import observe
from viewmend.rendering.crop import subject_crop
from viewmend.rendering.view import RenderConfig, render_view
from viewmend.views import MultiViewFrame

LEFT_OUT = 3
"""So many cameras are left out in turn, as far apart in the rig's order as can be."""
FEWEST_CAMERAS = 4
"""Rigs of fewer cameras are not fitted: what two of them show says little about what three show."""


class RigFit:
    """An inpainter, and whether it is still to be fitted to the rig; streams of one rig share it."""

    def __init__(self, inpainter: ViewInpainter, wanted: bool) -> None:
        self.inpainter = inpainter
        self.wanted = wanted

    def see(self, frame: MultiViewFrame, bounds: Bounds | None, hull: HullConfig, render: RenderConfig) -> None:
        """Fit the inpainter by the first frame that comes; later ones change nothing."""
        if self.wanted:
            self.wanted = False
            self.inpainter = fitted_to_rig(self.inpainter, frame, bounds, hull, render)


def fitted_to_rig(
    inpainter: ViewInpainter, frame: MultiViewFrame, bounds: Bounds | None, hull: HullConfig, render: RenderConfig
) -> ViewInpainter:
    """An inpainter that `FitsRig`, fitted to the rig by one of its frames; any other comes back as it is.

    Args:
        inpainter: who is to complete views of this rig.
        frame: what the rig's cameras saw at one time, with masks.
        bounds: the volume that may hold the subject; None to find it from the masks.
        hull: how the proxy is carved.
        render: how views are rendered; all that the inpainter is made for is asked of it, whatever the error rule.
    """
    names = frame.cameras.names
    if not isinstance(inpainter, FitsRig) or frame.mask is None or len(names) < FEWEST_CAMERAS:
        return inpainter
    render = replace(render, error_rule=own_error_rule(inpainter))
    chosen = [names[len(names) * number // LEFT_OUT] for number in range(LEFT_OUT)]
    held = [_held_out(inpainter, frame, name, bounds, hull, render) for name in chosen]
    return inpainter.fitted_to_rig([own for own in held if own is not None])


def _held_out(
    inpainter: ViewInpainter,
    frame: MultiViewFrame,
    name: str,
    bounds: Bounds | None,
    hull: HullConfig,
    render: RenderConfig,
) -> HeldOut | None:
    """The view of a camera without its image; None where the others do not see the subject."""
    own = frame.select([name])
    assert own.mask is not None, "the frame has masks"
    try:
        observation = observe(frame.without([name]), bounds, hull)
    except ValueError:  # no foreground is left
        return None
    assert isinstance(observation.proxy, GeometryProxy), "it was carved"
    view = render_view(observation.frame, observation.proxy, own.cameras, render, source_depth=observation.depth)
    truth = own.rgb[0].float() / 255 * (own.mask[0].float() / 255)
    margin_px = crop_margin_px(inpainter, RenderQuality())
    if margin_px is not None and (crop := subject_crop(view, margin_px)) is not None:
        view, truth = crop.of_view(view), crop.of_image(truth)
    return HeldOut(view, ContextProvider(lambda _, names: observation.context(names)), truth)
