"""Compiled CPU kernels of `sampler.py`, `pyramids.py` and `aggregation.py`, which hold the references in PyTorch.

Functions called in a kernel live in this file: numba does not recompile a kernel when another file changes.
"""

from math import exp, floor, sqrt, tanh

import numpy as np

from viewmend.models.views.config import CONTRAST, FAR, IN_VIEW, NEAR
from viewmend.utils.compiled import kernel

inlined = kernel(cache=False, inline="always")  # passing many arrays takes as long as the work itself


@kernel
def halve(image, half):
    """Rounded means of 2 x 2 pixels; images (row, column, channel) have a border of one black pixel."""
    rows, columns, channels = half.shape
    last_row = image.shape[0] - 1
    last_column = image.shape[1] - 1
    for row in range(1, rows - 1):
        top = 2 * row - 1
        below = min(top + 1, last_row)
        for column in range(1, columns - 1):
            left = 2 * column - 1
            right = min(left + 1, last_column)
            for c in range(channels):
                total = np.int32(image[top, left, c]) + np.int32(image[below, left, c])
                total += np.int32(image[top, right, c]) + np.int32(image[below, right, c])
                half[row, column, c] = (total + 2) >> 2


@kernel
def premultiply(rgb, mask, depth, out):
    """RGB on black, mask and coverage by the proxy, with a border of one black pixel."""
    height, width = mask.shape
    for row in range(height):
        for column in range(width):
            m = np.uint32(mask[row, column])
            if m > 0:
                for c in range(3):
                    out[row + 1, column + 1, c] = (np.uint32(rgb[c, row, column]) * m + 127) // 255
                out[row + 1, column + 1, 3] = m
            if depth[row, column] > 0:
                out[row + 1, column + 1, 4] = 255


@kernel
def average_boxes(image, first, step, side, out):
    """Means of channels from `first` on over boxes of `side` x `side` pixels, of every `step`-th row and column."""
    height = image.shape[0] - 1
    width = image.shape[1] - 1
    boxes_down, boxes_across, channels = out.shape
    for box_row in range(1, boxes_down - 1):
        top = 1 + (box_row - 1) * side * step
        for row in range(top, min(top + side * step, height), step):
            for box_column in range(1, boxes_across - 1):
                left = 1 + (box_column - 1) * side * step
                right = min(left + side * step, width)
                for c in range(first, first + channels):
                    total = 0
                    for column in range(left, right, step):
                        total += image[row, column, c]
                    out[box_row, box_column, c - first] += total
    out /= side**2


@inlined
def _position(chosen, camera):
    """Where a camera is among the chosen ones of a ray; -1 if it is not."""
    for view in range(chosen.shape[0]):
        if chosen[view] == camera:
            return view
    return -1


@inlined
def _project(per_metre, start, t, size):
    """Pixel and z-depth in a camera of a sample at z-depth t, and whether it is in view."""
    z = per_metre[2] * t + start[2]
    if not (t > 0 and z > 1e-6):
        return 0.0, 0.0, 0.0, False
    u = (per_metre[0] * t + start[0]) / z
    v = (per_metre[1] * t + start[1]) / z
    return u, v, z, u >= 0 and v >= 0 and u < size[0] and v < size[1]


@inlined
def _cosine(offset, direction, t):
    """Cosine of the angle at a sample between the ray and the camera, which is `offset` from the viewer."""
    x = offset[0] - t * direction[0]
    y = offset[1] - t * direction[1]
    z = offset[2] - t * direction[2]
    along = x * direction[0] + y * direction[1] + z * direction[2]
    squares = direction[0] * direction[0] + direction[1] * direction[1] + direction[2] * direction[2]
    return -along / max(sqrt((x * x + y * y + z * z) * squares), 1e-12)


@inlined
def _sample(image, u, v, scale, out, ray, sample, view, first, count):
    """The first `count` channels of an image with a border, bilinearly, in [0, 1], as channels from `first` on."""
    x = u * scale + 0.5
    y = v * scale + 0.5
    left = min(floor(x), image.shape[1] - 2)
    top = min(floor(y), image.shape[0] - 2)
    right = x - left
    below = y - top
    w00 = (1 - right) * (1 - below)
    w01 = right * (1 - below)
    w10 = (1 - right) * below
    w11 = right * below
    for c in range(count):
        out[ray, sample, view, first + c] = (1 / 255) * (
            w00 * image[top, left, c]
            + w01 * image[top, left + 1, c]
            + w10 * image[top + 1, left, c]
            + w11 * image[top + 1, left + 1, c]
        )


@inlined
def _catmull_rom(t):
    """Weights of the four values around a position `t` of the way from the second to the third."""
    a = t * (t * (1 - 0.5 * t) - 0.5)
    d = 0.5 * t * t * (t - 1)
    b = t * t * (1.5 * t - 2.5) + 1
    return a, b, 1 - a - b - d, d


@inlined
def _sample_cubic(image, u, v, scale, out, ray, sample, view, first, count):
    """`_sample` by Catmull-Rom splines, clamped to [0, 1]."""
    x = u * scale + 0.5
    y = v * scale + 0.5
    left = floor(x)
    top = floor(y)
    across = _catmull_rom(x - left)
    down = _catmull_rom(y - top)
    last_row = image.shape[0] - 1
    last_column = image.shape[1] - 1
    for c in range(count):
        total = 0.0
        for i in range(4):
            row = min(max(top + i - 1, 0), last_row)
            for j in range(4):
                total += down[i] * across[j] * image[row, min(max(left + j - 1, 0), last_column), c]
        out[ray, sample, view, first + c] = min(max((1 / 255) * total, 0.0), 1.0)


@inlined
def _covered_depth(depth, u, v):
    """Bilinear share of the pixels that have a depth, and the mean of their depths times it."""
    left = floor(u - 0.5)
    top = floor(v - 0.5)
    right = u - 0.5 - left
    below = v - 0.5 - top
    share = 0.0
    total = 0.0
    for row in range(max(0, top), min(depth.shape[0], top + 2)):
        for column in range(max(0, left), min(depth.shape[1], left + 2)):
            if depth[row, column] > 0:
                weight = (right if column > left else 1 - right) * (below if row > top else 1 - below)
                share += weight
                total += weight * depth[row, column]
    return share, total


@kernel
def sample_camera(
    first, end, camera, chosen, z, directions, per_metre, start, offset, size, images, scales, depth, size_m, is_source,
    min_coverage, cubic, out, prior,
):  # fmt: skip
    """`CameraFeatures` of the samples on rays first to end - 1 in one camera, and prior weights, not normalised.

    Only the rays are sampled that have this camera among their `chosen` ones. `cubic` applies to
    colour and mask. With a `min_coverage` above 0, distances behind the proxy are those of
    `RayFill`, and there are no prior weights.
    """
    fine, wide, shapes = images
    per_near = 1 / (NEAR * size_m)
    per_far = 1 / (FAR * size_m)
    extent = np.float32(size[0]), np.float32(size[1])
    for ray in range(first, end):
        view = _position(chosen[ray], camera)
        if view < 0:
            continue
        for sample in range(z.shape[1]):
            t = z[ray, sample]
            u, v, w, in_view = _project(per_metre[ray], start, t, extent)
            if not in_view:
                for c in range(out.shape[3]):
                    out[ray, sample, view, c] = 0.0
                prior[ray, sample, view] = 0.0
                continue
            if cubic:
                _sample_cubic(fine, u, v, scales[0], out, ray, sample, view, 0, 4)
            else:
                _sample(fine, u, v, scales[0], out, ray, sample, view, 0, 4)
            _sample(wide, u, v, scales[1], out, ray, sample, view, 9, wide.shape[2])
            cosine = _cosine(offset, directions[ray], t)
            if min_coverage > 0:
                _sample(shapes, u, v, scales[2], out, ray, sample, view, 12, 2)
                share, total = _covered_depth(depth, u, v)
                behind = w - total / share if share > min_coverage else 0.0
                near = tanh(behind * per_near)
                far = tanh(behind * per_far)
            else:
                surface = depth[min(int(v), size[1] - 1), min(int(u), size[0] - 1)]
                behind = w - surface if surface > 0 else 0.0
                near = behind * per_near / (1 + abs(behind * per_near))
                far = behind * per_far / (1 + abs(behind * per_far))
                prior[ray, sample, view] = exp(4 * cosine) / (1 + exp(6 * near))
            out[ray, sample, view, 4] = near
            out[ray, sample, view, 5] = far
            out[ray, sample, view, 6] = cosine
            out[ray, sample, view, 7] = is_source
            out[ray, sample, view, 8] = 1.0


@kernel
def score_camera(first, end, z, directions, per_metre, start, offset, size, depth, size_m, scores):
    """Adds up prior weights, not normalised, of the samples on rays first to end - 1 in one camera."""
    per_near = 1 / (NEAR * size_m)
    extent = np.float32(size[0]), np.float32(size[1])
    for ray in range(first, end):
        for sample in range(z.shape[1]):
            t = z[ray, sample]
            u, v, w, in_view = _project(per_metre[ray], start, t, extent)
            if in_view:
                surface = depth[min(int(v), size[1] - 1), min(int(u), size[0] - 1)]
                behind = (w - surface) * per_near if surface > 0 else 0.0
                cosine = _cosine(offset, directions[ray], t)
                scores[ray] += exp(4 * cosine) / (1 + exp(6 * behind / (1 + abs(behind))))


@kernel
def compare_cameras(first, end, features, prior, statistics):
    """Normalises prior weights; writes means and variances of colours by them, and differences from the means."""
    samples, views = prior.shape[1:]
    for ray in range(first, end):
        for sample in range(samples):
            total = 1e-6
            for view in range(views):
                total += prior[ray, sample, view]
            for view in range(views):
                prior[ray, sample, view] /= total
                features[ray, sample, view, 17] = prior[ray, sample, view]
            for c in range(3):
                mean = 0.0
                square = 0.0
                for view in range(views):
                    value = features[ray, sample, view, c]
                    weight = prior[ray, sample, view]
                    mean += weight * value
                    square += weight * value * value
                statistics[ray, sample, c] = mean
                statistics[ray, sample, 3 + c] = CONTRAST * max(0.0, square - mean * mean)
                for view in range(views):
                    inside = features[ray, sample, view, IN_VIEW]
                    features[ray, sample, view, 14 + c] = inside * (features[ray, sample, view, c] - mean)


@inlined
def _sample_mask(image, u, v, scale):
    """The only channel of an image with a border, as `_sample`."""
    x = u * scale + 0.5
    y = v * scale + 0.5
    left = min(int(x), image.shape[1] - 2)
    top = min(int(y), image.shape[0] - 2)
    right = np.float32(x - left)
    below = np.float32(y - top)
    top_left = np.float32(image[top, left, 0])
    low_left = np.float32(image[top + 1, left, 0])
    upper = top_left + right * (np.float32(image[top, left + 1, 0]) - top_left)
    lower = low_left + right * (np.float32(image[top + 1, left + 1, 0]) - low_left)
    return np.float32(1 / 255) * (upper + below * (lower - upper))


@kernel
def compare_silhouette(first, end, z, per_metre, start, size, images, scales, smallest):
    """Lowers the two smallest masks, and the two smallest averaged masks, of samples that this camera has in view."""
    samples = z.shape[1]
    width = np.float64(size[0])
    height = np.float64(size[1])
    u = np.empty(samples)
    v = np.empty(samples)
    for ray in range(first, end):
        for sample in range(samples):  # without branches, so that it is vectorised
            t = np.float64(z[ray, sample])
            depth = per_metre[ray, 2] * t + start[2]
            front = (t > 0) & (depth > 1e-6)
            inverse = 1 / (depth if front else 1.0)
            u[sample] = (per_metre[ray, 0] * t + start[0]) * inverse if front else -1.0
            v[sample] = (per_metre[ray, 1] * t + start[1]) * inverse
        for sample in range(samples):
            if u[sample] >= 0 and v[sample] >= 0 and u[sample] < width and v[sample] < height:
                found = smallest[ray, sample]
                mask = _sample_mask(images[0], u[sample], v[sample], scales[0])
                mean = _sample_mask(images[1], u[sample], v[sample], scales[1])
                found[1] = min(found[1], max(found[0], mask))
                found[0] = min(found[0], mask)
                found[3] = min(found[3], max(found[2], mean))
                found[2] = min(found[2], mean)


@kernel(fastmath={"reassoc", "contract", "nsz"})  # so that sums over features are vectorised
def aggregate(first, end, bias, features, statistics, prior, hidden, shared, weight, out, trust):
    """Softmax over the cameras that have a sample in view, and weighted sums over them, of rays first to end - 1."""
    _, samples, views, width = hidden.shape
    count = features.shape[3]
    channels = statistics.shape[2]
    for ray in range(first, end):
        for sample in range(samples):
            row = out[ray, sample]
            shares = trust[ray, sample]
            most = np.float32(-1e30)
            for view in range(views):
                if features[ray, sample, view, IN_VIEW] == 0:
                    continue
                own = hidden[ray, sample, view]
                score = np.float32(bias)
                for c in range(width):
                    own[c] = max(np.float32(0), own[c] + shared[ray, sample, c])
                    score += own[c] * weight[c]
                shares[view] = score
                most = max(most, score)
            total = np.float32(0)
            for view in range(views):
                if features[ray, sample, view, IN_VIEW] == 0:
                    shares[view] = np.float32(0)
                    continue
                relative = np.float32(exp(shares[view] - most))
                shares[view] = (prior[ray, sample, view] + np.float32(1e-3)) * relative
                total += shares[view]
            certain = np.float32(0)
            for view in range(views):
                if shares[view] == 0:
                    continue
                share = shares[view] / total
                shares[view] = share
                certain += share * share
                own = hidden[ray, sample, view]
                own_features = features[ray, sample, view]
                for c in range(width):
                    row[c] += share * own[c]
                for c in range(count):
                    row[width + c] += share * own_features[c]
                for c in range(3):
                    row[width + count + c] += share * own_features[c] * own_features[c]
            for c in range(3):
                mean = row[width + c]
                square = row[width + count + c]
                row[width + count + c] = np.float32(CONTRAST) * max(np.float32(0), square - mean * mean)
            for c in range(channels):
                row[width + count + 3 + c] = statistics[ray, sample, c]
            row[width + count + 3 + channels] = certain
