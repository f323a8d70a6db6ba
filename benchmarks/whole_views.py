"""Score whole views: python benchmarks/whole_views.py [--models NAME ...] [--sets SET ...] [--proxy KIND].

One frame of scenes in which a camera is left out. Each model runs with its own error rule. NAME@0.15 restricts it with
the rule `predicted` to that share of the hull, and NAME@0 samples no camera, as in a moving live view. SET is P,
Q:PERFORMERS, or CAPTURE:INPUTS, for example ../shared/captures/wd2:8. With the KIND fused, the
hull is tightened by predicted depth. With any other KIND, views of P and Q are rendered from other geometry: the exact
mesh, a decimated one, splatted points, or a noisy depth map.

Columns: LPIPS in the subject's box; `sharpness`, the mean gradient of the view over that of the truth; `damaged`, the
share of the pixels off by less than 0.05 as rendered that are off by more than 0.15 afterwards; `calibration`, the mean
distance of the confidence from the share of pixels that are correct, in ten bins of confidence. For P and Q, the depth
of the proxy in the view is also compared with the true depth.
"""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import cv2
import torch
from measure import write
from torch import Tensor
from torch.nn import functional as F

from viewmend.data.loose_masks import find_loose_masks
from viewmend.evaluation.scores import Scorers, TrueView, score_view, true_view
from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.mesh import Mesh, vertex_normals
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.rasterize import rasterize
from viewmend.geometry.rim import rim_depth
from viewmend.metrics.lpips import Lpips, load_lpips
from viewmend.models.base import RenderQuality
from viewmend.models.compositing import composite
from viewmend.models.registry import make_method
from viewmend.rendering.view import RenderConfig, render_depth
from viewmend.scenes.capture_scenes import CaptureScene, capture_set
from viewmend.scenes.held_out import LeaveOneOutFrame, LeaveOneOutScene
from viewmend.scenes.studio_scenes import StudioScene, performer_set, procedural_set
from viewmend.stream import Stream, StreamConfig
from viewmend.training.depth_geometry import DepthErrors, DepthMaps
from viewmend.training.views import CORRECT_DIFFERENCE
from viewmend.types import CompletedView, IncompleteView
from viewmend.utils.contact_sheet import Tile, contact_sheet, picture
from viewmend.utils.weight_files import MissingWeightsError

SHOWN = (
    "psnr_whole",
    "ssim_whole",
    "lpips_alex",
    "lpips_vgg",
    "sharpness",
    "damaged",
    "calibration",
    "psnr_holes",
    "alpha_iou",
)
PROXIES = ("hull", "fused", "exact", "decimated", "splats", "depth")
CELL_M, POINTS = 0.05, 40_000
"""Of decimated meshes and splatted points."""
NOISY = DepthErrors(noise_m=0.004, waves_m=0.008, step_m=0.008, holes=0.03)
RIGHT, WRONG = 0.05, 0.15
FAR_OFF_M = 0.05
"""Depth that is off by more than this is far off, metres."""
PADDING_PX = 16


def main() -> None:
    """Score every model on every set, and print a table of means."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--models", nargs="+", default=["unfilled", "telea", "rays", "views"])
    parser.add_argument("--sets", nargs="+", default=["P"])
    parser.add_argument("--views", type=int, default=8, help="number of views per set, evenly spaced")
    parser.add_argument("--size", type=int, default=320, help="width and height of the views of P and Q")
    parser.add_argument(
        "--background", choices=("black", "white"), default="black", help="background of views and truth"
    )
    parser.add_argument(
        "--proxy", choices=PROXIES, default="hull", help="geometry behind which views are rendered"
    )
    parser.add_argument(
        "--grow-masks", type=int, default=0, help="make the inputs' masks this many pixels too wide"
    )
    parser.add_argument(
        "--no-tighten-masks", action="store_true", help="leave loose masks of captures as they are"
    )
    parser.add_argument("--sheets", type=Path, help="folder for a picture of each view by each model")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    found = {name: judge(some(name, options.size, options.views), options) for name in options.sets}
    if options.write:
        config = {
            key: getattr(options, key)
            for key in (
                "models",
                "sets",
                "views",
                "size",
                "background",
                "proxy",
                "grow_masks",
                "no_tighten_masks",
            )
        }
        print(write("whole_views", "cpu", config, found))


def some(name: str, size_px: int, count: int) -> Sequence[LeaveOneOutScene]:
    """The chosen scenes of a set."""
    kind, _, rest = name.partition(":")
    if kind == "P":
        scenes: Sequence[LeaveOneOutScene] = procedural_set(1, size_px)
    elif kind == "Q":
        scenes = performer_set(Path(rest), frames=1, size_px=size_px)
    else:
        scenes = capture_set(Path(kind), rest or "all", 1)
    return [scenes[len(scenes) * n // count] for n in range(min(count, len(scenes)))]


def judge(
    scenes: Sequence[LeaveOneOutScene], options: argparse.Namespace
) -> dict[str, dict[str, float | None]]:
    """Print and return the mean scores of each model."""
    scores: dict[str, list[dict[str, float | None]]] = {model: [] for model in options.models}
    scorers, metrics = Scorers(options.background), perceptual_metrics()
    depths: list[dict[str, float]] = []
    for number, scene in enumerate(scenes):
        shown = {}
        for model, completed, truth in completed_views(scene, options, number):
            if isinstance(scene, StudioScene) and model == options.models[0]:
                depths.append(depth_scores(completed.view, scene))
            own = score_view(completed, truth, scorers)
            rgb = composite(options.background, completed.rgb, completed.opacity)
            rendered = composite(options.background, completed.view.rgb, completed.view.mask)
            found = {key: getattr(own, key, None) for key in SHOWN} | detail_scores(
                rgb, rendered, truth, metrics
            )
            found["calibration"] = calibration_error(rgb, completed, truth)
            scores[model].append(found)
            shown[f"{model} {own.psnr_whole:.2f} dB"] = completed.rgb
            shown["truth"] = shown.pop("truth", truth.rgb)  # at the end
        if options.sheets:
            save(shown, options.sheets / f"{scene.name}.png")
    means = {model: mean_scores(own) for model, own in scores.items()}
    print(f"{scenes[0].set}, {len(scenes)} views: {', '.join(SHOWN)}")
    for model, own in means.items():
        figures = (value if (value := own[key]) is not None else float("nan") for key in SHOWN)
        print(f"  {model:28s}", *(f"{figure:7.4f}" for figure in figures), flush=True)
    if depths:
        mean_depths = {key: round(fmean(own[key] for own in depths), 4) for key in depths[0]}
        print(f"  depth of the proxy: {mean_depths}", flush=True)
    return means


def depth_scores(view: IncompleteView, scene: StudioScene) -> dict[str, float]:
    """Errors of the proxy's depth in a view, in millimetres and as shares of the true surface.

    "extra" are pixels with depth where there is no surface.
    """
    true_depth = rasterize(scene.studio().scene(0).mesh, view.camera).depth[0]
    there = true_depth > 0
    found = view.depth > 0
    error_m = (view.depth - true_depth)[there & found].abs()
    surface_px = float(there.sum())
    return {
        "mean_mm": 1e3 * float(error_m.mean()),
        "median_mm": 1e3 * float(error_m.median()),
        "far_off": float((error_m > FAR_OFF_M).sum()) / surface_px,
        "missing": float((there & ~found).sum()) / surface_px,
        "extra": float((found & ~there).sum()) / surface_px,
    }


def perceptual_metrics() -> dict[str, Lpips]:
    """LPIPS with AlexNet and, where its weights are installed, with VGG16."""
    metrics = {"lpips_alex": load_lpips("alex")}
    with suppress(MissingWeightsError):
        metrics["lpips_vgg"] = load_lpips("vgg")
    return metrics


def detail_scores(
    rgb: Tensor, rendered: Tensor, truth: TrueView, metrics: dict[str, Lpips]
) -> dict[str, float | None]:
    """The scores of one view that `score_view` does not have."""
    (top, bottom), (left, right) = ((int(at.min()), int(at.max()) + 1) for at in torch.nonzero(truth.mask).T)
    box = (
        slice(max(0, top - PADDING_PX), bottom + PADDING_PX),
        slice(max(0, left - PADDING_PX), right + PADDING_PX),
    )
    found: dict[str, float | None] = {
        name: float(metric(rgb[None, :, *box], truth.rgb[None, :, *box])) for name, metric in metrics.items()
    }
    inside = truth.mask & (F.avg_pool2d(truth.mask[None].float(), 5, 1, 2)[0] > 0.99)
    found["sharpness"] = float(gradient(rgb)[inside].mean() / gradient(truth.rgb)[inside].mean())
    before, after = ((image - truth.rgb).abs().amax(0) for image in (rendered, rgb))
    was_right = (before < RIGHT) & truth.mask
    found["damaged"] = float((after[was_right] > WRONG).float().mean()) if bool(was_right.any()) else None
    return found


def calibration_error(rgb: Tensor, completed: CompletedView, truth: TrueView) -> float | None:
    """Expected calibration error of the confidence that no channel is off by a tenth, over the predicted pixels."""
    if completed.confidence is None or not bool((inside := completed.view.error > 0).any()):
        return None
    confidence, correct = (
        completed.confidence[inside],
        ((rgb - truth.rgb).abs().amax(0) < CORRECT_DIFFERENCE)[inside].float(),
    )
    part = (10 * confidence).long().clamp(0, 9)
    gap = torch.zeros(10).index_add_(0, part, confidence - correct)
    return float(gap.abs().sum() / len(confidence))


def gradient(image: Tensor) -> Tensor:
    """Magnitude of the differences to the next pixels, mean over the channels."""
    down, right = (F.pad(image.diff(dim=axis), pad) for axis, pad in ((1, (0, 0, 0, 1)), (2, (0, 1))))
    return (down.square() + right.square()).sqrt().mean(0)


def completed_views(
    scene: LeaveOneOutScene, options: argparse.Namespace, number: int
) -> Iterator[tuple[str, CompletedView, TrueView]]:
    """The first frame of a scene by each model, and the truth."""
    frame = first_frame(scene, options)
    truth, target = true_view(frame.truth, options.background), frame.truth.cameras
    geometry = other_geometry(scene, frame, target, options.proxy, number)
    for model in options.models:
        name, _, fraction = model.partition("@")
        part = float(fraction or 0)
        rule = RenderConfig(error_rule="predicted", refine_fraction=part) if part else RenderConfig()
        config = StreamConfig(memory_mb=None, render=rule, background=options.background)
        stream = Stream(make_method(name), config, frame.bounds)
        cached = stream.add_frame(frame.inputs, geometry)
        if isinstance(geometry, DepthMaps):
            depth = geometry.maps[geometry.names.index("target")]
            view, _ = render_depth(frame.inputs, target, depth, cached.depth, rule)
            if stream.error_rule != "holes":
                view = replace(view, error=(rim_depth(view.depth) > 0).to(view.error))
            quality = RenderQuality(refine_fraction=part if fraction else None)
            yield model, stream.mend(view, quality=quality).completed, truth
        else:
            quality = RenderQuality(refine_fraction=0.0 if fraction and not part else None)
            yield model, stream.view(target, quality=quality).completed, truth


def first_frame(scene: LeaveOneOutScene, options: argparse.Namespace) -> LeaveOneOutFrame:
    """The first frame of a scene; the masks of its inputs are grown, then tightened, if the options say so."""
    grown_px, tighten = options.grow_masks, not options.no_tighten_masks
    if isinstance(scene, CaptureScene):
        scene = replace(scene, tighten_masks=tighten and not grown_px)
    frame = next(iter(scene.frames()))
    if not grown_px:
        return frame
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * grown_px + 1, 2 * grown_px + 1))
    masks = frame.inputs.mask
    assert masks is not None, "scenes have masks"
    grown = replace(
        frame.inputs, mask=torch.stack([torch.from_numpy(cv2.dilate(own.numpy(), disc)) for own in masks])
    )
    loose = find_loose_masks(grown) if tighten else None
    return replace(frame, inputs=grown if loose is None else loose.apply(grown))


def other_geometry(
    scene: LeaveOneOutScene, frame: LeaveOneOutFrame, target: Cameras, kind: str, number: int
) -> GeometryProxy | DepthMaps | None:
    """The fused geometry, or the true surface of a studio scene as another renderer may know it; None for the hull.

    The names of depth maps end with the novel view's.
    """
    inputs = frame.inputs
    if kind == "hull":
        return None
    if kind == "fused":
        stream = Stream(make_method("views"), StreamConfig(memory_mb=None, geometry="fused"), frame.bounds)
        proxy = stream.add_frame(inputs).proxy
        assert isinstance(proxy, GeometryProxy)
        return proxy
    assert isinstance(scene, StudioScene), "other geometry is for P and Q"
    studio = scene.studio()
    mesh, rng = studio.scene(0).mesh, torch.Generator().manual_seed(number)
    assert studio.bounds is not None, "the studio knows its bounds"
    if kind == "decimated":
        cells, own = (mesh.vertices / CELL_M).round().unique(dim=0, return_inverse=True)
        count = torch.zeros(len(cells)).index_add_(0, own, torch.ones(len(own)))
        vertices = torch.zeros(len(cells), 3).index_add_(0, own, mesh.vertices) / count[:, None]
        faces = own[mesh.faces.long()]
        kept = (faces != faces.roll(1, 1)).all(1)
        mesh = Mesh(vertices, faces[kept].to(mesh.faces))
    if kind in ("exact", "decimated"):
        return GeometryProxy(mesh, vertex_normals(mesh), studio.bounds)
    exact = [*rasterize(mesh, inputs.cameras).depth, rasterize(mesh, target).depth[0]]
    if kind == "depth":
        maps = [NOISY.apply(own, rng) for own in exact]
    else:
        corners = mesh.vertices[mesh.faces.long()]
        area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1)
        share = torch.empty(POINTS, 3).exponential_(generator=rng)
        face = torch.multinomial(area, POINTS, replacement=True, generator=rng)
        points = (corners[face] * (share / share.sum(1, keepdim=True))[..., None]).sum(1)
        maps = [*splat(points, inputs.cameras), *splat(points, target)]
    size = [max(own.shape[axis] for own in maps) for axis in (0, 1)]
    padded = [F.pad(own, (0, size[1] - own.shape[1], 0, size[0] - own.shape[0])) for own in maps]
    height, width = target.max_size_px[::-1]
    padded[-1] = padded[-1][:height, :width]
    return DepthMaps((*inputs.cameras.names, "target"), torch.stack(padded))


def splat(points: Tensor, cameras: Cameras) -> list[Tensor]:
    """Depth maps of points drawn as squares of three pixels."""
    width, height = cameras.max_size_px
    maps = []
    for uv, z in zip(*project(points, cameras), strict=True):
        depth = torch.full((height * width,), torch.inf)
        for row in (-1, 0, 1):
            for column in (-1, 0, 1):
                x, y = (uv + torch.tensor([column, row])).floor().long().unbind(1)
                there = (x >= 0) & (y >= 0) & (x < width) & (y < height) & (z > 0)
                depth.scatter_reduce_(0, (y * width + x)[there], z[there], "amin")
        maps.append(torch.where(depth.isinf(), 0.0, depth).view(height, width))
    return maps


def mean_scores(scores: Sequence[dict[str, float | None]]) -> dict[str, float | None]:
    """Means over the views that have a score."""
    found = {key: [value for own in scores if (value := own.get(key)) is not None] for key in SHOWN}
    return {key: round(fmean(values), 4) if values else None for key, values in found.items()}


def save(shown: dict[str, Tensor], path: Path) -> None:
    """Write the images side by side, cropped to the subject."""
    there = torch.stack([image.amax(0) > 0 for image in shown.values()]).any(0)
    (top, bottom), (left, right) = ((int(at.min()), int(at.max()) + 1) for at in torch.nonzero(there).T)
    part = (
        slice(max(0, top - PADDING_PX), bottom + PADDING_PX),
        slice(max(0, left - PADDING_PX), right + PADDING_PX),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet = contact_sheet([[Tile(name, picture(image[:, *part])) for name, image in shown.items()]])
    cv2.imwrite(str(path), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    main()
