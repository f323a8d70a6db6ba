"""Slow references of the ray fill's samples and neighbourhoods: one pixel, one point, one camera at a time."""

import numpy as np
from reference.blend_twin import unit


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
    rgb, mask, coverage, surface = np.zeros(3), 0.0, 0.0, 0.0
    for row, column, share in four_beyond(u, v):
        if 0 <= row < frame.rgb.shape[2] and 0 <= column < frame.rgb.shape[3]:
            there = float(ray_views.depth[index, row, column])
            fore = float(frame.mask[index, row, column]) / 255
            rgb += share * fore * frame.rgb[index, :, row, column].double().numpy() / 255
            mask += share * fore
            coverage += share * (there > 0)
            surface += share * there
    behind = (z - surface / coverage) / size_m if coverage > 0.3 else 0.0
    centre = -pose[:3, :3].T @ pose[:3, 3]
    cosine = unit(centre - point) @ unit(viewer - point)
    chosen = camera.names[0] in view.source_views
    masks, proxy = frame.mask.double().numpy() / 255, (ray_views.depth.numpy() > 0).astype(float)
    size_px = float(np.sqrt(masks.sum((1, 2)).mean()))
    side, half = max(1, round(outline * size_px)), max(1, round(patch / 2 * size_px))
    black = frame.rgb[index].double().numpy() / 255 * masks[index]
    colours = [mean_around(channel[::2, ::2], half, u / 2, v / 2) for channel in black]
    around = [*colours, mean_around(masks[index], side, u, v), mean_around(proxy[index], side, u, v)]
    return np.array([*rgb, mask, np.tanh(behind / near), np.tanh(behind / far), cosine, chosen, 1, *around])


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
    rows, columns = silhouettes.mask.shape[1:]
    around = [(r, c, share) for r, c, share in four_beyond(u, v) if 0 <= r < rows and 0 <= c < columns]
    masks = silhouettes.mask.double().numpy() / 255
    side = max(1, round(outline * np.sqrt(masks.sum((1, 2)).mean())))
    return sum(share * masks[index, r, c] for r, c, share in around), mean_around(masks[index], side, u, v)


def mean_around(image, side, u, v):
    """The image's mean over squares, between the four squares around (u, v)."""
    total = 0.0
    for row, column, share in four_beyond(u / side, v / side):
        if row >= 0 and column >= 0:
            square = image[row * side : (row + 1) * side, column * side : (column + 1) * side]
            total += share * square.sum() / side**2
    return total


def four_beyond(u, v):
    """The four pixels around (u, v), with bilinear shares; also those beyond the border."""
    left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    right_share, lower_share = u - 0.5 - left, v - 0.5 - top
    for row, vertical in ((top, 1 - lower_share), (top + 1, lower_share)):
        for column, horizontal in ((left, 1 - right_share), (left + 1, right_share)):
            yield row, column, vertical * horizontal
