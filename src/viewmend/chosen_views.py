"""Some cameras of one time by reference: a view needs few pixels, and to copy all takes as long as its work."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from viewmend.views import ContextViews, MultiViewFrame


def each(views: MultiViewFrame | ContextViews, field: str) -> Sequence[Tensor]:
    """The image of every camera in a field, nothing copied; none where the field is None."""
    parts = vars(views).get("parts", {})
    if field in parts:
        return parts[field]
    images = getattr(views, field)
    return () if images is None else images.unbind()


class _Stacked:
    """Fields whose images are put into one tensor when somebody asks for it."""

    parts: dict[str, Sequence[Tensor]]

    if not TYPE_CHECKING:  # to whom they are fields as others are

        def __new__(cls, *values: object, **fields: object) -> object:
            """What `dataclasses.replace` makes of it is a copy, of the plain class."""
            plain = cls.__mro__[2]
            return plain(*values, **fields) if values or fields else object.__new__(cls)

        def __getattr__(self, field: str) -> Tensor:
            parts = vars(self).get("parts", {})
            if field not in parts:
                raise AttributeError(f"{type(self).__name__} has no {field}")
            vars(self)[field] = torch.stack(tuple(parts[field]))
            return vars(self)[field]


class ChosenFrame(_Stacked, MultiViewFrame):
    """What `MultiViewFrame.select` gives, by reference, and without true depth."""

    @classmethod
    def of(cls, frame: MultiViewFrame, names: Sequence[str]) -> "ChosenFrame":
        """The same time seen by these cameras alone, in this order; ValueError for an unknown name."""
        chosen, cameras = cls.__new__(cls), frame.cameras.select(names)
        width, height = cameras.max_size_px
        index = [frame.cameras.names.index(name) for name in names]
        vars(chosen).update(cameras=cameras, time=frame.time, depth=None, mask=None, parts={})
        for field in ("rgb", "mask"):
            if images := each(frame, field):
                chosen.parts[field] = [images[own][..., :height, :width] for own in index]
                vars(chosen).pop(field, None)
        return chosen


class ChosenViews(_Stacked, ContextViews):
    """Cameras of one time and the proxy's depth in each, by reference."""

    @classmethod
    def of(cls, frame: MultiViewFrame, names: Sequence[str], depths: Mapping[str, Tensor]) -> "ChosenViews":
        """What these cameras saw, in this order; ValueError for an unknown name.

        Args:
            frame: what all cameras saw.
            names: of some of them.
            depths: the proxy's z-depth in each, (height width), metres, at least as large as the cameras' images.
        """
        chosen, own = cls.__new__(cls), ChosenFrame.of(frame, names)
        width, height = own.cameras.max_size_px
        parts = {"depth": [depths[name][:height, :width] for name in names]}
        vars(chosen).update(frame=own, part=None, parts=parts)
        return chosen

    def select(self, names: Sequence[str]) -> "ChosenViews":
        """What those of these cameras that are there saw, in the order of `names`."""
        own = self.frame.cameras.names
        return self.of(self.frame, [n for n in names if n in own], dict(zip(own, each(self, "depth"), strict=True)))
