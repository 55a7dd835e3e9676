// Item form of blend.cl (see there), for CPUs: a work-item owns a tile; a row of 16 pixels is one
// vector; the tile's state lives in private memory; rows a splat's ellipse does not reach, or that are
// opaque, are skipped.

// A row of the tile, cut at the right border of the image.
inline void store_row(real16 value, __global real *row, int columns)
{
    if (columns >= TILE) {
        vstore16(value, 0, row);
        return;
    }
    real values[16];
    vstore16(value, 0, values);
    for (int i = 0; i < columns; i++)
        row[i] = values[i];
}

inline real16 load_row(__global const real *row, int columns)
{
    if (columns >= TILE)
        return vload16(0, row);
    real values[16];
    for (int i = 0; i < 16; i++)
        values[i] = i < columns ? row[i] : 0;
    return vload16(0, values);
}

// Rows [*begin, *end) of the tile that the ellipse reaches.
inline void rows_reached(__global const real *splat, real first_y, int rows, int *begin, int *end)
{
    const real up = splat[SPLAT_MEAN + 1] - first_y, extent = splat[SPLAT_EXTENT_Y];
    *begin = (int)clamp(ceil(up - extent), (real)0, (real)rows);
    *end = (int)clamp(floor(up + extent) + 1, (real)0, (real)rows);
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void blend(BLEND_ARGUMENTS)
{
    const int tile = get_global_id(0), place = first_tile + tile;
    const int x0 = place % tiles_x * TILE, y0 = place / tiles_x * TILE;
    const int columns = min(TILE, width - x0), rows = min(TILE, height - y0);
    const uint begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const real16 x = IOTA + (real)(x0 + 0.5);
    const real first_y = y0 + 0.5;
    real16 t[TILE], red[TILE], green[TILE], blue[TILE]; // t < 0: the pixel has ended, |t| remains
    mask16 latest[TILE]; // the last pair a pixel can have seen; beyond it nothing reaches it
#if WITH_DEPTH
    real16 z[TILE];
#endif
    for (int r = 0; r < rows; r++) {
        t[r] = select((real16)-1, (real16)1, TO_MASK(IOTA < (real)columns));
        red[r] = green[r] = blue[r] = 0;
        latest[r] = (int)end - 1;
#if WITH_DEPTH
        z[r] = 0;
#endif
    }
    int open_rows = (1 << rows) - 1;
    for (uint i = begin; i < end && open_rows; i++) {
        SPLAT_IN_ROWS(sorted_splats[i]);
        int r, r_end;
        rows_reached(splat, first_y, rows, &r, &r_end);
        for (; r < r_end; r++) {
            if (!(open_rows >> r & 1))
                continue;
            const real dy = first_y + r - mean_y;
            const real16 power = power_x + dy * (c * dy - shear);
            const mask16 live = TO_MASK(power >= cut) & TO_MASK(t[r] > 0);
            if (!any16(live))
                continue;
            const real16 alpha = select((real16)0, cut_alpha(opacity * exp_power(power)), live);
            real16 w = alpha * t[r], next = t[r] - w;
            const mask16 ends = live & TO_MASK(next < (real)TRANSMITTANCE_MIN);
            if (any16(ends)) {
                w = select(w, (real16)0, ends);
                next = select(next, -t[r], ends);
                latest[r] = select(latest[r], (mask16)i - 1, ends);
                if (!any16(TO_MASK(next > 0)))
                    open_rows &= ~(1 << r);
            }
            red[r] += w * splat[SPLAT_COLOUR];
            green[r] += w * splat[SPLAT_COLOUR + 1];
            blue[r] += w * splat[SPLAT_COLOUR + 2];
#if WITH_DEPTH
            z[r] += w * splat[SPLAT_DEPTH];
#endif
            t[r] = next;
        }
    }
    const long plane = (long)width * height;
    for (int r = 0; r < rows; r++) {
        const long pixel = (long)(y0 + r) * width + x0;
        const real16 rest = fabs(t[r]);
        store_row(red[r] + rest * background[0], image + pixel, columns);
        store_row(green[r] + rest * background[1], image + plane + pixel, columns);
        store_row(blue[r] + rest * background[2], image + 2 * plane + pixel, columns);
        store_row(rest, transmittance + pixel, columns);
#if WITH_DEPTH
        store_row(z[r], depth + pixel, columns);
#endif
        int indices[16];
        vstore16(convert_int16(latest[r]), 0, indices);
        for (int i = 0; i < columns; i++)
            last_contributor[pixel + i] = indices[i];
    }
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void blend_adjoint(BLEND_ADJOINT_ARGUMENTS,
                   __global const real *restrict background)
{
    const int tile = get_global_id(0), place = first_tile + tile;
    const int x0 = place % tiles_x * TILE, y0 = place / tiles_x * TILE;
    const int columns = min(TILE, width - x0), rows = min(TILE, height - y0);
    const int begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const long plane = (long)width * height;
    const real16 x = IOTA + (real)(x0 + 0.5);
    const real first_y = y0 + 0.5;
    // t: transmittance behind the current splat; behind: grad . light from behind it
    real16 t[TILE], behind[TILE], grad_red[TILE], grad_green[TILE], grad_blue[TILE];
    mask16 latest[TILE];
#if WITH_DEPTH
    real16 grad_z[TILE];
#endif
    int newest = -1;
    for (int r = 0; r < rows; r++) {
        const long pixel = (long)(y0 + r) * width + x0;
        t[r] = load_row(transmittance + pixel, columns);
        grad_red[r] = load_row(grad_image + pixel, columns);
        grad_green[r] = load_row(grad_image + plane + pixel, columns);
        grad_blue[r] = load_row(grad_image + 2 * plane + pixel, columns);
        behind[r] = t[r] * (grad_red[r] * background[0] + grad_green[r] * background[1] +
                            grad_blue[r] * background[2]);
#if WITH_DEPTH
        grad_z[r] = load_row(grad_depth + pixel, columns);
        behind[r] += t[r] * load_row(grad_transmittance + pixel, columns);
#endif
        int indices[16];
        for (int i = 0; i < 16; i++) {
            indices[i] = i < columns ? last_contributor[pixel + i] : -1;
            newest = max(newest, indices[i]);
        }
        latest[r] = convert_mask16(vload16(0, indices));
    }
    for (int i = end - 1; i >= begin; i--) {
        __global real *sum = pair_grads + (ulong)emission_indices[i] * SUMS;
        if (i > newest) {
            for (int j = 0; j < SUMS; j++)
                sum[j] = 0;
            continue;
        }
        SPLAT_IN_ROWS(sorted_splats[i]);
        real16 s_red = 0, s_green = 0, s_blue = 0, s_opacity = 0, s_z = 0;
        real16 s_p = 0, s_y = 0, s_yy = 0; // dx is the same in every row: its products come last
        int r, r_end;
        rows_reached(splat, first_y, rows, &r, &r_end);
        for (; r < r_end; r++) {
            const real dy = first_y + r - mean_y;
            const real16 power = power_x + dy * (c * dy - shear);
            const mask16 live = TO_MASK(power >= cut) & TO_MASK(latest[r] >= (mask16)i);
            if (!any16(live))
                continue;
            const real16 e = exp_power(power), raw = opacity * e;
            const real16 alpha = select((real16)0, cut_alpha(raw), live);
            const real16 inverse = 1 / (1 - alpha);
            const real16 before = t[r] * inverse, w = alpha * before;
            real16 light = grad_red[r] * splat[SPLAT_COLOUR] +
                           grad_green[r] * splat[SPLAT_COLOUR + 1] +
                           grad_blue[r] * splat[SPLAT_COLOUR + 2];
#if WITH_DEPTH
            light += grad_z[r] * splat[SPLAT_DEPTH];
            s_z += w * grad_z[r];
#endif
            s_red += w * grad_red[r];
            s_green += w * grad_green[r];
            s_blue += w * grad_blue[r];
            const real16 grad_alpha = before * light - behind[r] * inverse;
            const real16 grad_raw =
                select((real16)0, grad_alpha * cut_alpha_slope(raw), live);
            behind[r] += w * light;
            t[r] = before;
            s_opacity += grad_raw * e;
            const real16 grad_power = grad_raw * raw;
            s_p += grad_power;
            s_y += grad_power * dy;
            s_yy += grad_power * (dy * dy);
        }
        // in the order of splat.h
        vstore8(sum16_each(s_red, s_green, s_blue, s_opacity, s_p * dx, s_y, s_p * dx * dx,
                           s_y * dx), 0, sum);
        sum[SUM_YY] = sum16(s_yy);
#if WITH_DEPTH
        sum[SUM_DEPTH] = sum16(s_z);
#endif
    }
}

// An element is a splat; eight columns are one vector, or Intel's compiler would sum every column over
// several pairs at a time, in another order.
__kernel void sum_pairs(uint carried, __global const uint *restrict counts,
                        __global const uint *restrict splat_counts,
                        __global const uint *restrict offsets,
                        __global const real *restrict pair_grads, __global real *restrict totals)
{
    FOR_EACH(v, counts[COUNT_VISIBLE]) {
        __global real *own = totals + v * SUMS;
        real8 total = carried ? vload8(0, own) : (real8)(0);
        real rest[SUMS - 8];
        for (int j = 0; j < SUMS - 8; j++)
            rest[j] = carried ? own[8 + j] : 0;
        const ulong begin = (ulong)offsets[v] * SUMS, end = begin + (ulong)splat_counts[v] * SUMS;
        for (ulong i = begin; i < end; i += SUMS) {
            total += vload8(0, pair_grads + i);
            for (int j = 0; j < SUMS - 8; j++)
                rest[j] += pair_grads[i + 8 + j];
        }
        vstore8(total, 0, own);
        for (int j = 0; j < SUMS - 8; j++)
            own[8 + j] = rest[j];
    }
}
