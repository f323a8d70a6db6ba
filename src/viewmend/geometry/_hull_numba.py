"""The hull on the CPU, fast: blocks of space are judged whole, single voxels only where masks have edges."""

import numpy as np

from viewmend.utils.compiled import kernel

UNSEEN = 0
"""A camera does not see the block."""
EMPTY = 1
"""The block is outside of a camera's mask."""
FULL = 2
"""The block is inside a camera's mask."""
MIXED = 3
"""The edge of a camera's mask crosses the block."""
NEAR_M = 1e-6
"""Points with a smaller z-depth than this, in metres, are behind a camera."""


@kernel
def soften(mask, rows, columns, pool, out):
    """Average squares of pool x pool pixels and smooth the averages by (1 2 1)/4 along both axes, rounded to 8 bits.

    Beyond the image's own rows and columns its border continues, and by one row and column beyond the
    pooled mask; `out` may be larger.
    """
    height = -(-mask.shape[0] // pool)
    width = -(-mask.shape[1] // pool)
    smooth = np.empty((height, width), np.int32)
    column_sums = np.empty(width * pool, np.int32)
    pooled = np.empty(width, np.int32)
    for y in range(height):
        column_sums[:] = 0
        for j in range(pool):
            line = mask[min(y * pool + j, rows - 1)]
            for x in range(min(columns, width * pool)):
                column_sums[x] += line[x]
        for x in range(columns, width * pool):
            column_sums[x] = column_sums[columns - 1]
        for x in range(width):
            total = 0
            for i in range(pool):
                total += column_sums[x * pool + i]
            pooled[x] = total
        for x in range(1, width - 1):
            smooth[y, x] = pooled[x - 1] + 2 * pooled[x] + pooled[x + 1]
        smooth[y, 0] = 3 * pooled[0] + pooled[min(1, width - 1)]
        smooth[y, width - 1] = pooled[max(width - 2, 0)] + 3 * pooled[width - 1]
    scale = np.float32(1) / np.float32(16 * pool * pool)
    for y in range(height):
        above = max(y - 1, 0)
        below = min(y + 1, height - 1)
        for x in range(width):
            total = smooth[above, x] + 2 * smooth[y, x] + smooth[below, x]
            out[y, x] = np.uint8(np.float32(total) * scale + np.float32(0.5))
        out[y, width] = out[y, width - 1]
    out[height, : width + 1] = out[height - 1, : width + 1]


@kernel
def count_tiles(image, rows, columns, tile, sums):
    """Summed-area tables: how many tiles have any foreground (sums[..., 0]), how many are all of it (sums[..., 1]).

    Tiles beyond the rows and columns have none and are all of it: they decide nothing.
    """
    sums[:] = 0
    largest = np.empty(columns, np.uint8)
    smallest = np.empty(columns, np.uint8)
    for ty in range(sums.shape[0] - 1):
        largest[:] = 0
        smallest[:] = 255
        for y in range(ty * tile, min(ty * tile + tile, rows)):
            line = image[y]
            for x in range(columns):
                largest[x] = max(largest[x], line[x])
                smallest[x] = min(smallest[x], line[x])
        for tx in range(sums.shape[1] - 1):
            some = 0
            full = 1
            for x in range(tx * tile, min(tx * tile + tile, columns)):
                some |= largest[x] > 0
                full &= smallest[x] == 255
            sums[ty + 1, tx + 1, 0] = sums[ty, tx + 1, 0] + sums[ty + 1, tx, 0] - sums[ty, tx, 0] + some
            sums[ty + 1, tx + 1, 1] = sums[ty, tx + 1, 1] + sums[ty + 1, tx, 1] - sums[ty, tx, 1] + full


@kernel(inline="always")
def judge(P, lens, x, y, z, radius, size, pool, tile, sums):
    """Classify a ball in one camera: not in view, all background, all foreground, or mixed.

    The ball's image lies within radius |p1 - u p3| / (depth - radius) of its centre's u, likewise
    v, where p1 and p3 are rows of P; with `lens` = (fx^2 + skew^2, cx, fy^2, cy), |p1 - u p3|^2 =
    fx^2 + skew^2 + (cx - u)^2.
    """
    depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    if depth + radius <= NEAR_M:
        return UNSEEN
    if depth - radius <= NEAR_M:
        return MIXED
    inverse = 1 / depth
    reach = radius / (depth - radius)
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) * inverse
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) * inverse
    du = np.sqrt(lens[0] + (lens[1] - u) ** 2) * reach
    dv = np.sqrt(lens[2] + (lens[3] - v) ** 2) * reach
    width = size[0]
    height = size[1]
    if u + du < 0 or u - du >= width or v + dv < 0 or v - dv >= height:
        return UNSEEN
    if u - du < 0 or u + du >= width or v - dv < 0 or v + dv >= height:
        return MIXED
    # Bilinear sampling reads the pixel before and the one after.
    shrink = 1 / (pool * tile)
    last_x = sums.shape[1] - 2
    last_y = sums.shape[0] - 2
    margin = 1.5 * pool
    left = np.int64(max(u - du - margin, 0.0) * shrink)
    right = min(np.int64((u + du + margin) * shrink), last_x) + 1
    top = np.int64(max(v - dv - margin, 0.0) * shrink)
    bottom = min(np.int64((v + dv + margin) * shrink), last_y) + 1
    some = sums[bottom, right, 0] - sums[top, right, 0] - sums[bottom, left, 0] + sums[top, left, 0]
    if some == 0:
        return EMPTY
    full = sums[bottom, right, 1] - sums[top, right, 1] - sums[bottom, left, 1] + sums[top, left, 1]
    return FULL if full == (bottom - top) * (right - left) else MIXED


@kernel
def occupied_blocks(P, lens, size, tile, sums, low, block_m, needed, slab, occupied):
    """Mark the blocks of one slab along x that no camera calls empty and enough cameras may see."""
    radius = block_m * np.sqrt(3.0) / 2
    x = low[0] + (slab + 0.5) * block_m
    for j in range(occupied.shape[1]):
        y = low[1] + (j + 0.5) * block_m
        for k in range(occupied.shape[2]):
            z = low[2] + (k + 0.5) * block_m
            seen = 0
            for view in range(P.shape[0]):
                verdict = judge(P[view], lens[view], x, y, z, radius, size[view], 1, tile, sums[view])
                if verdict == EMPTY:
                    seen = -1
                    break
                seen += verdict != UNSEEN
            occupied[slab, j, k] = seen >= needed


@kernel
def carve_blocks(P, lens, size, soft, pools, tile, sums, low, voxel_m, needed, block, first, values):
    """Fill values[first : first + block]: the smallest mask value over the cameras that see each voxel's middle."""
    end_x = min(first + block, values.shape[0])
    end_y = values.shape[1]
    end_z = values.shape[2]
    radius = voxel_m * np.sqrt(3.0) / 2 * (block - 1) + 1e-9
    order = np.arange(P.shape[0])
    mixed = np.empty(P.shape[0], np.int64)
    scratch = np.empty((8, block**3), np.float32)
    for first_y in range(0, end_y, block):
        for first_z in range(0, end_z, block):
            x = low[0] + (first + block / 2) * voxel_m
            y = low[1] + (first_y + block / 2) * voxel_m
            z = low[2] + (first_z + block / 2) * voxel_m
            seen = 0
            undecided = 0
            for n in range(len(order)):
                view = order[n]
                verdict = judge(
                    P[view], lens[view], x, y, z, radius, size[view], pools[view], tile, sums[view]
                )
                if verdict == EMPTY:
                    # It will call the next block empty as well: ask it first.
                    order[n] = order[0]
                    order[0] = view
                    seen = -1
                    break
                if verdict == FULL:
                    seen += 1
                elif verdict == MIXED:
                    mixed[undecided] = view
                    undecided += 1
            box = values[
                first:end_x, first_y : min(first_y + block, end_y), first_z : min(first_z + block, end_z)
            ]
            if seen < 0 or seen + undecided < needed:
                box[:] = 0
            elif undecided == 0:
                box[:] = 1
            else:
                corner = (low[0] + first * voxel_m, low[1] + first_y * voxel_m, low[2] + first_z * voxel_m)
                carve_voxels(
                    P, size, soft, pools, corner, voxel_m, needed, seen, mixed[:undecided], box, scratch
                )


@kernel
def carve_voxels(P, size, soft, pools, low, voxel_m, needed, seen_before, views, values, scratch):
    """Fill `values` with the smallest bilinear mask value of the `views` that see a voxel; 0 where too few do.

    One camera after another is asked about the voxels that are left, gathered at the front of `scratch`.
    """
    x = scratch[0]
    y = scratch[1]
    z = scratch[2]
    smallest = scratch[3]
    seen = scratch[4]
    place = scratch[5]
    left = 0
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            for k in range(values.shape[2]):
                x[left] = i
                y[left] = j
                z[left] = k
                smallest[left] = 255
                seen[left] = seen_before
                place[left] = left
                left += 1
    origin = (low[0] + 0.5 * voxel_m, low[1] + 0.5 * voxel_m, low[2] + 0.5 * voxel_m)
    for n in range(len(views)):
        view = views[n]
        locate(P[view], origin, voxel_m, size[view], pools[view], left, scratch)
        kept = sample(soft[view], left, scratch)
        if kept < left // 2:
            # A camera that empties much of this block will empty much of the next: ask it first.
            views[n] = views[0]
            views[0] = view
        left = kept
        if left == 0:
            break
    values[:] = 0
    plane = np.uint32(values.shape[1] * values.shape[2])
    line = np.uint32(values.shape[2])
    for n in range(left):
        if seen[n] >= needed:
            at = np.uint32(place[n])
            values[at // plane, at % plane // line, at % line] = smallest[n] / np.float32(255)


@kernel(fastmath=True)
def locate(P, origin, voxel_m, size, pool, count, scratch):
    """Where the first `count` voxels are in one camera's pooled mask: scratch[6:8]; -1 in scratch[6] if out of view."""
    u_row = voxel_row(P[0], origin, voxel_m, 1.0 / pool)
    v_row = voxel_row(P[1], origin, voxel_m, 1.0 / pool)
    z_row = voxel_row(P[2], origin, voxel_m, 1.0)
    width = np.float32(size[0] / pool)
    height = np.float32(size[1] / pool)
    one = np.float32(1)
    nothing = np.float32(0)
    near = np.float32(NEAR_M)
    x = scratch[0]
    y = scratch[1]
    z = scratch[2]
    us = scratch[6]
    vs = scratch[7]
    for n in range(count):
        depth = z_row[0] + x[n] * z_row[1] + y[n] * z_row[2] + z[n] * z_row[3]
        inverse = one / max(depth, near)
        u = (u_row[0] + x[n] * u_row[1] + y[n] * u_row[2] + z[n] * u_row[3]) * inverse
        v = (v_row[0] + x[n] * v_row[1] + y[n] * v_row[2] + z[n] * v_row[3]) * inverse
        sees = (depth > near) & (u >= nothing) & (u < width) & (v >= nothing) & (v < height)
        us[n] = u if sees else -one
        vs[n] = v


@kernel(inline="always")
def voxel_row(row, origin, voxel_m, scale):
    """A row of P times `scale`, as a function of voxel indices: its value at `origin`, its steps along x, y, z."""
    first = row[0] * origin[0] + row[1] * origin[1] + row[2] * origin[2] + row[3]
    step = scale * voxel_m
    return (
        np.float32(scale * first),
        np.float32(step * row[0]),
        np.float32(step * row[1]),
        np.float32(step * row[2]),
    )


@kernel(fastmath=True)
def sample(image, count, scratch):
    """Lower the first `count` voxels' values to the mask's at scratch[6:8]; move those still above 0 to the front."""
    x = scratch[0]
    y = scratch[1]
    z = scratch[2]
    smallest = scratch[3]
    seen = scratch[4]
    place = scratch[5]
    us = scratch[6]
    vs = scratch[7]
    half = np.float32(0.5)
    nothing = np.float32(0)
    one = np.float32(1)
    last_y = np.float32(image.shape[0] - 2)
    last_x = np.float32(image.shape[1] - 2)
    kept = 0
    for n in range(count):
        value = smallest[n]
        if us[n] >= 0:
            seen[n] += one
            u = min(max(us[n] - half, nothing), last_x)
            v = min(max(vs[n] - half, nothing), last_y)
            value = min(value, bilinear(image, u, v))
        if value > 0:
            x[kept] = x[n]
            y[kept] = y[n]
            z[kept] = z[n]
            smallest[kept] = value
            seen[kept] = seen[n]
            place[kept] = place[n]
            kept += 1
    return kept


@kernel(inline="always")
def bilinear(image, u, v):
    """The image at (u, v) >= 0; (0, 0) is the centre of its first pixel. (u + 1, v + 1) must be in it, too."""
    one = np.float32(1)
    # Unsigned, so that numba does not look for negative indices.
    left = np.uint32(np.int32(u))
    top = np.uint32(np.int32(v))
    right = np.uint32(left + 1)
    bottom = np.uint32(top + 1)
    a = u - np.float32(left)
    b = v - np.float32(top)
    over = np.float32(image[top, left]) * (one - a) + np.float32(image[top, right]) * a
    under = np.float32(image[bottom, left]) * (one - a) + np.float32(image[bottom, right]) * a
    return over * (one - b) + under * b


@kernel
def summarise(values, faint, iso, block, blocks, faint_blocks, inside, filled):
    """Mark what values of a grid lie above `faint` and `iso`, of which `faint` is lower.

    `filled` and `inside` are the planes across x, then y, then z with any value above `faint` and
    `iso`; `blocks` are the cubes of `block` values along each side with any of at least `iso`, and
    `faint_blocks` those with any above `faint`.
    """
    across_y = values.shape[0]
    across_z = across_y + values.shape[1]
    for x in range(values.shape[0]):
        for y in range(values.shape[1]):
            for z in range(values.shape[2]):
                value = values[x, y, z]
                if value > faint:
                    faint_blocks[x // block, y // block, z // block] = True
                    filled[x] = True
                    filled[across_y + y] = True
                    filled[across_z + z] = True
                    if value >= iso:
                        blocks[x // block, y // block, z // block] = True
                    if value > iso:
                        inside[x] = True
                        inside[across_y + y] = True
                        inside[across_z + z] = True
