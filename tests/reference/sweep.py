"""Plane sweep of one photo over others, and which of these confirm its depths, float64 (cl/sweep.cl
has the contract)."""

import numpy as np

SIDE, REACH, FINE = 7, 3, 7
LEAST_VARIANCE = 1e-6
NO_MATCH = -1.0


def sweep(images, sizes, sources, warps, first, spacing, planes):
    """inverse_depths and scores [H, W] of photo 0, and by how much the best plane of the sweep and
    of the fine planes is ahead of the next [H, W]; images [V, H, W], warps [S, 12]."""
    _, height, width = images.shape
    depths, scores, ahead = np.zeros((3, height, width))
    columns, rows = sizes[0]
    if min(columns, rows) < SIDE:
        return depths, scores, ahead
    y, x = (index.ravel() for index in np.mgrid[REACH : rows - REACH, REACH : columns - REACH])

    def at_planes(stride, inverse_depths):
        """The scores [P, K] at inverse depths [P, K] of all pixels, nan without texture."""
        dy, dx = (index.ravel() - REACH for index in np.mgrid[0:SIDE:stride, 0:SIDE:stride])
        own = images[0][y[:, None] + dy, x[:, None] + dx]
        middle = own.mean(axis=1, keepdims=True)
        textured = own.var(axis=1) >= LEAST_VARIANCE
        found = [
            [
                np.where(
                    textured,
                    correlation(
                        own - middle,
                        (x + 0.5, y + 0.5),
                        w,
                        images[source][: sizes[source][1], : sizes[source][0]],
                        warp,
                        (dx, dy),
                        middle,
                    ),
                    np.nan,
                )
                for source, warp in zip(sources, warps)
            ]
            for w in inverse_depths.T
        ]
        best = np.sort(np.array(found), axis=1)[:, -2:]  # a single source has no second
        return (best.sum(axis=1) + NO_MATCH * (2 - best.shape[1])).T / 2

    every = first + spacing * np.arange(planes)
    swept = at_planes(2, np.broadcast_to(every, (len(x), planes)))
    at = np.argmax(np.nan_to_num(swept, nan=NO_MATCH), axis=1)
    near = every[at][:, None] + (np.arange(FINE) - FINE // 2) * spacing / 2
    fine = at_planes(1, near)
    chosen = np.argmax(np.nan_to_num(fine, nan=NO_MATCH), axis=1)
    pixel = np.arange(len(x))
    counted = (at > 0) & (at < planes - 1) & (fine[pixel, chosen] > NO_MATCH)
    shift = np.zeros(len(x))
    inner = counted & (chosen > 0) & (chosen < FINE - 1)
    below, best, above = (fine[pixel[inner], chosen[inner] + step] for step in (-1, 0, 1))
    bend = below - 2 * best + above
    with np.errstate(divide="ignore", invalid="ignore"):
        shift[inner] = np.where(bend < -1e-6, np.clip((below - above) / (2 * bend), -0.5, 0.5), 0)
    depth = near[pixel, chosen] + shift * spacing / 2
    depths[y, x] = np.where(counted, depth, 0)
    scores[y, x] = np.where(counted, fine[pixel, chosen], 0)
    ahead[y, x] = np.minimum(
        *(np.diff(np.sort(np.nan_to_num(each, nan=NO_MATCH))[:, -2:])[:, 0] for each in (swept, fine))
    )
    return depths, scores, ahead


def correlation(own, pixel, inverse_depth, source, warp, offsets, middle):
    """[P]: of windows `own` [P, T] around pixels (x, y), whose mean is 0, with their places."""
    height, width = source.shape
    matrix, shift = warp[:9].reshape(3, 3), warp[9:]
    q = matrix @ [*pixel, np.ones(len(own))] + shift[:, None] * inverse_depth
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        centre = q[:2] / q[2]
        jacobian = (matrix[:2, :2, None] - centre[:, None] * matrix[2, :2, None]) / q[2]
        u, v = centre[:, :, None] + np.einsum("ijp,jt->ipt", jacobian, offsets)
    inside = (q[2] > 0) & (centre >= 0).all(axis=0) & (centre.T <= (width, height)).all(axis=1)
    u, v = (np.clip(np.nan_to_num(place - 0.5), 0, most - 1) for place, most in ((u, width), (v, height)))
    x, y = (np.minimum(place.astype(int), most - 2) for place, most in ((u, width), (v, height)))
    fx, fy = u - x, v - y
    values = (
        (1 - fy) * ((1 - fx) * source[y, x] + fx * source[y, x + 1])
        + fy * ((1 - fx) * source[y + 1, x] + fx * source[y + 1, x + 1])
    ) - middle
    variance = values.var(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (own * values).mean(axis=1) / np.sqrt((own**2).mean(axis=1) * variance)
    return np.where(inside & (variance >= LEAST_VARIANCE), found, NO_MATCH)


def confirm(inverse_depths, sizes, cameras, reference, sources, same_depth):
    """confirmed [H, W], and how near each pixel is to another number of sources, as a relative
    depth or in pixels of a source [H, W]; each pixel is projected as a point."""
    height, width = inverse_depths[reference].shape
    counts, margin = np.zeros((height, width), int), np.full((height, width), np.inf)
    own = cameras[reference]
    for row, column in zip(*np.nonzero(inverse_depths[reference] > 0)):
        z = 1 / inverse_depths[reference][row, column]
        ray = [(column + 0.5 - own.centre[0]) / own.focal[0], (row + 0.5 - own.centre[1]) / own.focal[1], 1.0]
        point = own.rotation.T @ (z * np.array(ray) - own.translation)
        for source in sources:
            pixel, depth = cameras[source].project(point[None])
            (u, v), depth = pixel[0], depth[0]
            columns, rows = sizes[source]
            to_border = np.abs(pixel[0] - np.rint(pixel[0]))
            margin[row, column] = min(margin[row, column], *to_border)
            if not (depth > 0 and 0 <= u < columns and 0 <= v < rows):
                continue
            known = inverse_depths[source][int(v), int(u)]
            if known > 0:
                off = abs(1 / known - depth) / depth
                counts[row, column] += off < same_depth
                margin[row, column] = min(margin[row, column], abs(off - same_depth))
    return counts, margin
