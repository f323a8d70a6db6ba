"""Slow, obvious twin of viewmend.rendering.blending.blend: one pixel, one camera, one formula at a time."""

import numpy as np


def blend_twin(camera, depth, normals, sources, bias_m, config):
    """Colour [3 h w], raw weights [camera h w] and disagreement [h w], in double precision."""
    frame = sources.frame
    height, width = depth.shape
    rgb = np.zeros((3, height, width))
    weights = np.zeros((len(frame.cameras), height, width))
    disagreement = np.zeros((height, width))
    for y, x in np.argwhere(depth.numpy() > 0):
        ray = np.linalg.inv(camera.K[0].double().numpy()) @ [x + 0.5, y + 0.5, 1]
        pose = np.linalg.inv(camera.camera_from_world[0].double().numpy())
        point = pose[:3, :3] @ (ray * float(depth[y, x])) + pose[:3, 3]
        normal = unit(normals[y, x].double().numpy())
        colours = np.zeros((len(frame.cameras), 3))
        for view in range(len(frame.cameras)):
            weights[view, y, x], colours[view] = one_camera(
                point, normal, unit(pose[:3, 3] - point), frame, sources.depth, view, bias_m, config
            )
        total = weights[:, y, x].sum()
        if total > 0:
            share = weights[:, y, x] / total
            rgb[:, y, x] = share @ colours
            disagreement[y, x] = np.sqrt((share @ (colours - rgb[:, y, x]) ** 2).mean())
    return rgb, weights, disagreement


def one_camera(point, normal, to_viewer, frame, depths, view, bias_m, config):
    """Weight and colour of one camera at one surface point."""
    camera = frame.cameras[view]
    world = camera.camera_from_world[0].double().numpy()
    in_camera = world[:3, :3] @ point + world[:3, 3]
    z = in_camera[2]
    if z <= 0:
        return 0, np.zeros(3)
    u, v, _ = camera.K[0].double().numpy() @ in_camera / z
    width, height = camera.size_px[0].tolist()
    if not (0 <= u <= width and 0 <= v <= height):
        return 0, np.zeros(3)
    to_camera = unit(-world[:3, :3].T @ world[:3, 3] - point)
    cosine = max(0, min(1, normal @ to_camera))
    tangent = np.sqrt(1 - cosine**2) / max(cosine, 0.1)
    tolerance = bias_m + config.slope_px * z / float(camera.K[0, 0, 0]) * tangent
    usable, colour = 0.0, np.zeros(3)
    for row, column, share in four_around(u, v, width, height):
        there = float(depths[view, row, column])
        if there > 0 and z - there > tolerance:
            continue
        part = share * (float(frame.mask[view, row, column]) / 255 if frame.mask is not None else 1)
        usable += part
        colour += part * frame.rgb[view, :, row, column].double().numpy() / 255
    if usable == 0:
        return 0, colour
    weight = usable * cosine**config.normal_power * max(0, to_viewer @ to_camera) ** config.view_power
    return weight, colour / usable


def four_around(u, v, width, height):
    """The four pixels around (u, v), whose centres are at halves, with bilinear shares; the border repeats."""
    left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    for row in (top, top + 1):
        for column in (left, left + 1):
            share = (1 - abs(u - 0.5 - column)) * (1 - abs(v - 0.5 - row))
            yield min(max(row, 0), height - 1), min(max(column, 0), width - 1), share


def unit(vector):
    return vector / np.linalg.norm(vector)
