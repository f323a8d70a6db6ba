"""The plan and the net of tiny runs that read whole views."""

from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.rendering.view import RenderConfig
from viewmend.training.plan import DataPlan

VIEW_PLAN = DataPlan(sizes_px=(96,), cameras=(5, 6), times=(0,), held_cameras=2, ray_views=4, hull_resolution=48)
VIEW_MODEL = SweepConfig(num_views=4, width=8, place_channels=4, features=8, fine_features=8, error_features=8)
VIEW_RULE = RenderConfig(error_rule="all")
