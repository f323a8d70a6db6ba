"""Slow references of the ray fill's samples and neighbourhoods: one pixel, one point, one camera at a time."""

import numpy as np
from reference.blend_twin import unit
from scipy.ndimage import map_coordinates
from skimage.measure import block_reduce


def sample_fill_reference(view, pixels, ray_views, offsets, near, far, outline, patch):
    """Features [pixel point view 14] and smallest masks [pixel point 4], in double precision."""
    depth = view.depth.double().numpy()
    focal = np.sqrt(float(view.camera.K[0, 0, 0] * view.camera.K[0, 1, 1]))
    covered = np.sort(depth[depth > 0])
    size_m = np.sqrt((view.mask > 0).sum().item()) * covered[(len(covered) - 1) // 2] / focal
    pose = np.linalg.inv(view.camera.camera_from_world[0].double().numpy())
    features = np.zeros((len(pixels), len(offsets), len(ray_views.frame.cameras), 14))
    smallest = np.ones((*features.shape[:2], 4))
    for number, (row, column) in enumerate(pixels.tolist()):
        ray = np.linalg.inv(view.camera.K[0].double().numpy()) @ [column + 0.5, row + 0.5, 1]
        for point, offset in enumerate(offsets):
            at = pose[:3, :3] @ (ray * (depth[row, column] + offset * size_m)) + pose[:3, 3]
            for camera in range(features.shape[2]):
                seen = look(at, pose[:3, 3], view, ray_views, camera, size_m, near, far, outline, patch)
                features[number, point, camera] = seen
            seen = [see_mask(at, view.silhouettes, i, outline) for i in range(len(view.silhouettes.cameras))]
            masks, around = zip(*seen, strict=True)
            smallest[number, point] = [*sorted([*masks, 1.0, 1.0])[:2], *sorted([*around, 1.0, 1.0])[:2]]
    return features, smallest


def look(point, viewer, view, ray_views, index, size_m, near, far, outline, patch):
    """The features of one point in one camera; zeros where it is out of view."""
    camera, frame = ray_views.frame.cameras[index], ray_views.frame
    pose = camera.camera_from_world[0].double().numpy()
    x, y, z = pose[:3, :3] @ point + pose[:3, 3]
    width, height = camera.size_px[0].tolist()
    if z <= 0:
        return np.zeros(14)
    u, v, _ = camera.K[0].double().numpy() @ [x / z, y / z, 1]
    if not (0 <= u < width and 0 <= v < height):
        return np.zeros(14)
    masks, depth = frame.mask.double().numpy() / 255, ray_views.depth.double().numpy()
    proxy, black = (depth > 0).astype(float), frame.rgb[index].double().numpy() / 255 * masks[index]
    coverage, surface = look_up(proxy[index], u, v), look_up(depth[index], u, v)
    behind = (z - surface / coverage) / size_m if coverage > 0.3 else 0.0
    centre = -pose[:3, :3].T @ pose[:3, 3]
    cosine = unit(centre - point) @ unit(viewer - point)
    chosen = camera.names[0] in view.source_views
    size_px = float(np.sqrt(masks.sum((1, 2)).mean()))
    side, half = max(1, round(outline * size_px)), max(1, round(patch / 2 * size_px))
    colours = [mean_around(channel[::2, ::2], half, u / 2, v / 2) for channel in black]
    around = [*colours, mean_around(masks[index], side, u, v), mean_around(proxy[index], side, u, v)]
    seen = [look_up(image, u, v) for image in (*black, masks[index])]
    return np.array([*seen, np.tanh(behind / near), np.tanh(behind / far), cosine, chosen, 1, *around])


def neighbourhoods_reference(view, guess, pixels, sizes, reach):
    """Means over cells of `sizes` around each pixel, [pixel 12 11 11]."""
    depth, subject = view.depth.double().numpy(), view.mask.numpy() > 0
    focal = np.sqrt(float(view.camera.K[0, 0, 0] * view.camera.K[0, 1, 1]))
    covered = np.sort(depth[depth > 0])
    median = covered[(len(covered) - 1) // 2]
    size_m = np.sqrt(subject.sum()) * median / focal
    beyond = np.where(depth > 0, 0.5 + 0.5 * np.tanh((depth - median) / size_m), 0)
    shown = [*guess.double().numpy(), view.mask.double().numpy(), view.error.double().numpy(), beyond]
    means = np.zeros((len(pixels), len(sizes), len(shown), 2 * reach + 1, 2 * reach + 1))
    for which, size in enumerate(sizes):
        side = max(1, round(size * np.sqrt(subject.sum())))
        middle_column, middle_row = (int(np.floor(float(c))) for c in view.camera.K[0, :2, 2])
        for number, (row, column) in enumerate(pixels.tolist()):
            for down in range(-reach, reach + 1):
                for across in range(-reach, reach + 1):
                    top = middle_row + ((row - middle_row) // side + down) * side
                    left = middle_column + ((column - middle_column) // side + across) * side
                    rows, columns = (slice(max(0, first), max(0, first + side)) for first in (top, left))
                    cell = [image[rows, columns].sum() / side**2 for image in shown]
                    means[number, which, :, reach + down, reach + across] = cell
    return means.reshape(len(pixels), -1, 2 * reach + 1, 2 * reach + 1)


def see_mask(point, silhouettes, index, outline):
    """The mask of one camera at a point, and its mean around; 1 where it is out of view."""
    camera = silhouettes.cameras[index]
    x, y, z = (camera.camera_from_world[0].double().numpy() @ [*point, 1])[:3]
    if z <= 0:
        return 1.0, 1.0
    u, v, _ = camera.K[0].double().numpy() @ [x / z, y / z, 1]
    width, height = camera.size_px[0].tolist()
    if not (0 <= u < width and 0 <= v < height):
        return 1.0, 1.0
    masks = silhouettes.mask.double().numpy() / 255
    side = max(1, round(outline * np.sqrt(masks.sum((1, 2)).mean())))
    return look_up(masks[index], u, v), mean_around(masks[index], side, u, v)


def mean_around(image, side, u, v):
    """The image's mean over squares, between the four squares around (u, v)."""
    return look_up(block_reduce(image, side, np.mean), u / side, v / side)


def look_up(image, u, v):
    """The image between its pixels, whose centres are at halves; beyond the border it is black."""
    return map_coordinates(image, [[v - 0.5], [u - 0.5]], order=1, mode="grid-constant")[0]
