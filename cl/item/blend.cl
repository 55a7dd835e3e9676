// Item form of blend.cl (see there), for CPUs: a work-item owns a tile; a row of 16 pixels is one
// vector; the tile's state lives in private memory; blocks of rows that a splat's ellipse does not
// reach, or that are opaque, are skipped.

#include "prefetch.h"

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

inline void store_indices(int16 value, __global int *row, int columns)
{
    if (columns >= TILE) {
        vstore16(value, 0, row);
        return;
    }
    int values[16];
    vstore16(value, 0, values);
    for (int i = 0; i < columns; i++)
        row[i] = values[i];
}

inline int16 load_indices(__global const int *row, int columns)
{
    if (columns >= TILE)
        return vload16(0, row);
    int values[16];
    for (int i = 0; i < 16; i++)
        values[i] = i < columns ? row[i] : -1;
    return vload16(0, values);
}

// Rows are blended BLOCK at a time, so that the operations of one fill the waits of another. A row
// of a block that an ellipse does not reach adds nothing, as its excess is below zero. EACH_ROW
// writes its argument, which has no commas outside parentheses, once for each row k: PoCL would not
// unroll a loop, nor keep arrays in registers.
#define BLOCK 4
#define CHUNK 16 // pairs whose terms along x are kept for all blocks
#define EACH_ROW(BODY) ONE_ROW(0, BODY) ONE_ROW(1, BODY) ONE_ROW(2, BODY) ONE_ROW(3, BODY)
#define ONE_ROW(K, BODY)                                                                           \
    {                                                                                              \
        const int k = K;                                                                           \
        BODY                                                                                       \
    }

// The depth channel after a splat of weight w, before which the transmittance was t.
inline real16 with_depth(real16 z, real depth, real16 w, real16 t)
{
    return DEPTH_PERCENT
               ? select(z, (real16)depth, TO_MASK(w > 0) & TO_MASK(t > (real)DEPTH_AT))
               : z + w * depth;
}

// Whether an ellipse reaches a row of the block that begins at `block_y`; a hair larger (tiles.h),
// so that no pixel whose excess rounds to zero is left out.
inline bool reaches_block(__global const real *splat, real block_y)
{
    const real extent = splat[SPLAT_EXTENT_Y] * 1.001 + (0.01 + 0.5 * (BLOCK - 1));
    return fabs(block_y + 0.5 * (BLOCK - 1) - splat[SPLAT_MEAN + 1]) <= extent;
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void blend(BLEND_ARGUMENTS)
{
    const int tile = get_global_id(0), place = first_tile + tile, tiles_x = TILES_X;
    const int x0 = place % tiles_x * TILE, y0 = place / tiles_x * TILE;
    const int columns = min(TILE, width - x0), rows = min(TILE, height - y0);
    const uint begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const real16 x = IOTA + (real)(x0 + 0.5);
    const long plane = (long)width * height;
    // t < 0: the pixel has ended, |t| remains
    real16 t_of[TILE], colour_of[CHANNELS][TILE];
    mask16 latest_of[TILE]; // the last pair a pixel can have seen; beyond it nothing reaches it
    IF_DEPTH(real16 z_of[TILE];)
    for (int r = 0; r < TILE; r++) {
        t_of[r] = r < rows ? select((real16)-1, (real16)1, TO_MASK(IOTA < (real)columns)) : -1;
        EACH_CHANNEL(colour_of[channel][r] = 0;)
        latest_of[r] = (int)end - 1;
        IF_DEPTH(z_of[r] = 0;)
    }
    int open_blocks = (1 << (rows + BLOCK - 1) / BLOCK) - 1;
    for (uint first = begin; first < end && open_blocks; first += CHUNK) {
        const uint last = min(first + CHUNK, end);
        real16 excess_x_of[CHUNK], shear_of[CHUNK];
        for (uint i = last; i < min(last + CHUNK, end); i++)
            PREFETCH_ROW(splats, sorted_splats[i], SPLAT_REALS);
        for (uint i = first; i < last; i++) {
            SPLAT_IN_ROWS(sorted_splats[i]);
            excess_x_of[i - first] = excess_x;
            shear_of[i - first] = shear;
        }
        for (int r0 = 0; r0 < rows; r0 += BLOCK) {
            if (!(open_blocks >> r0 / BLOCK & 1))
                continue;
            const real block_y = y0 + r0 + 0.5;
            real16 t[BLOCK], colour[CHANNELS][BLOCK];
            mask16 latest[BLOCK];
            IF_DEPTH(real16 z[BLOCK];)
            EACH_ROW(
                t[k] = t_of[r0 + k];
                EACH_CHANNEL(colour[channel][k] = colour_of[channel][r0 + k];)
                latest[k] = latest_of[r0 + k];
                IF_DEPTH(z[k] = z_of[r0 + k];))
            bool open = true;
            for (uint i = first; i < last && open; i++) {
                __global const real *splat = splats + (ulong)sorted_splats[i] * SPLAT_REALS;
                if (!reaches_block(splat, block_y))
                    continue;
                __global const real *colours = COLOURS_OF(splat, sorted_splats[i]);
                const real c = (real)(-0.5 * LOG2_E) * splat[SPLAT_CONIC + 2];
                const real mean_y = splat[SPLAT_MEAN + 1];
                const real16 excess_x = excess_x_of[i - first], shear = shear_of[i - first];
                real16 excess[BLOCK], w[BLOCK], next[BLOCK];
                mask16 live[BLOCK], ends[BLOCK];
                EACH_ROW(
                    const real dy = block_y + k - mean_y;
                    excess[k] = excess_x + dy * (c * dy - shear);
                    live[k] = TO_MASK(excess[k] >= 0) & TO_MASK(t[k] > 0);)
                EACH_ROW(w[k] = select((real16)0, cut_alpha(alpha_of(excess[k])), live[k]) * t[k];)
                EACH_ROW(
                    next[k] = t[k] - w[k];
                    ends[k] = live[k] & TO_MASK(next[k] < (real)TRANSMITTANCE_MIN);)
                if (any16(ends[0] | ends[1] | ends[2] | ends[3])) {
                    EACH_ROW(
                        w[k] = select(w[k], (real16)0, ends[k]);
                        next[k] = select(next[k], -t[k], ends[k]);
                        latest[k] = select(latest[k], (mask16)i - 1, ends[k]);)
                    open = any16(TO_MASK(next[0] > 0) | TO_MASK(next[1] > 0) |
                                 TO_MASK(next[2] > 0) | TO_MASK(next[3] > 0));
                }
                EACH_ROW(
                    EACH_CHANNEL(colour[channel][k] += w[k] * colours[channel];)
                    IF_DEPTH(z[k] = with_depth(z[k], splat[SPLAT_DEPTH], w[k], t[k]);)
                    t[k] = next[k];)
            }
            EACH_ROW(
                t_of[r0 + k] = t[k];
                EACH_CHANNEL(colour_of[channel][r0 + k] = colour[channel][k];)
                latest_of[r0 + k] = latest[k];
                IF_DEPTH(z_of[r0 + k] = z[k];))
            if (!open)
                open_blocks &= ~(1 << r0 / BLOCK);
        }
    }
    IF_RESPONSE(Response response; LOAD_RESPONSE(response);)
    for (int r = 0; r < rows; r++) {
        const long pixel = (long)(y0 + r) * width + x0;
        const real16 rest = fabs(t_of[r]);
        real16 colour[CHANNELS];
        EACH_CHANNEL(
            colour[channel] = colour_of[channel][r] + rest * background[channel];
            store_row(colour[channel], image + channel * plane + pixel, columns);)
        IF_RESPONSE(
            respond(&response, RADIUS(, response, x, (real16)(y0 + r + 0.5)), colour);
            EACH_CHANNEL(store_row(colour[channel], exposed + channel * plane + pixel, columns);))
        store_row(rest, transmittance + pixel, columns);
        IF_DEPTH(store_row(z_of[r], depth + pixel, columns);)
        store_indices(convert_int16(latest_of[r]), last_contributor + pixel, columns);
    }
}

// The rows of a tile that an ellipse reaches, from the first of a block on: those of reaches_block.
inline void reached_rows(__global const real *splat, real first_y, int *begin, int *end)
{
    const real extent = splat[SPLAT_EXTENT_Y] * 1.001 + 0.01;
    const real beyond = splat[SPLAT_MEAN + 1] - first_y + 1;
    *begin = (int)fmin(fmax(beyond - extent, (real)0), (real)TILE) / BLOCK * BLOCK;
    *end = (int)fmin(fmax(beyond + extent, (real)0), (real)TILE);
}

// The gradient by the power, of a row of the adjoint: as long as alpha is raw, w is before * raw.
#define GRAD_POWER                                                                                 \
    (SMOOTH_CUTOFF                                                                                 \
         ? select((real16)0, before * contrast * raw[k] * cut_alpha_slope(raw[k]), live[k])        \
         : select((real16)0, w * contrast, live[k] & TO_MASK(raw[k] <= (real)ALPHA_MAX)))

#define LIGHT(C) grad[C][r] * colours[C] // of a splat, weighted by the gradient

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void blend_adjoint(BLEND_ADJOINT_ARGUMENTS, __global const real *restrict background)
{
    const int tile = get_global_id(0), place = first_tile + tile, tiles_x = TILES_X;
    const int x0 = place % tiles_x * TILE, y0 = place / tiles_x * TILE;
    const int columns = min(TILE, width - x0), rows = min(TILE, height - y0);
    const int begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const long plane = (long)width * height;
    const real16 x = IOTA + (real)(x0 + 0.5);
    const real first_y = y0 + 0.5;
    // t: transmittance behind the current splat; behind: grad . colour of what lies behind it
    real16 t[TILE], behind[TILE], grad[CHANNELS][TILE];
    mask16 latest[TILE];
    IF_DEPTH(real16 grad_z[TILE];)
    int16 newest_each = -1;
    for (int r = 0; r < TILE; r++) {
        if (r >= rows) { // below the image
            t[r] = behind[r] = 0;
            EACH_CHANNEL(grad[channel][r] = 0;)
            latest[r] = -1;
            IF_DEPTH(grad_z[r] = 0;)
            continue;
        }
        const long pixel = (long)(y0 + r) * width + x0;
        t[r] = load_row(transmittance + pixel, columns);
        EACH_CHANNEL(grad[channel][r] = load_row(grad_image + channel * plane + pixel, columns);)
#define BACKGROUND_LIGHT(C) grad[C][r] * background[C]
        ADD_CHANNELS(behind[r], BACKGROUND_LIGHT);
        IF_DEPTH(
            grad_z[r] = load_row(grad_depth + pixel, columns);
            behind[r] += load_row(grad_transmittance + pixel, columns);)
        const int16 indices = load_indices(last_contributor + pixel, columns);
        newest_each = max(newest_each, indices);
        latest[r] = convert_mask16(indices);
    }
    const int8 newest8 = max(newest_each.lo, newest_each.hi);
    const int4 newest4 = max(newest8.lo, newest8.hi);
    const int2 newest2 = max(newest4.lo, newest4.hi);
    const int newest = max(newest2.x, newest2.y);
    for (int i = end - 1; i >= begin; i--) {
        __global real *sum = pair_grads + (ulong)emission_indices[i] * SUMS;
        if (i > newest) {
            for (int j = 0; j < SUMS; j++)
                sum[j] = 0;
            continue;
        }
        const int soon = max(i - AHEAD, begin);
        PREFETCH_ROW(splats, sorted_splats[soon], SPLAT_REALS);
        PREFETCH_ROW(pair_grads, emission_indices[soon], SUMS);
        SPLAT_IN_ROWS(sorted_splats[i]);
        __global const real *colours = COLOURS_OF(splat, sorted_splats[i]);
        int r_begin, r_end;
        reached_rows(splat, first_y, &r_begin, &r_end);
        real16 s_colour[COLOUR_SUMS], s_z = 0;
        for (int j = 0; j < COLOUR_SUMS; j++)
            s_colour[j] = 0;
        real16 s_p = 0, s_y = 0, s_yy = 0; // dx is the same in every row: its products come last
        for (int r0 = r_begin; r0 < r_end; r0 += BLOCK) {
            const real block_y = first_y + r0;
            real16 raw[BLOCK], alpha[BLOCK], inverse[BLOCK];
            mask16 live[BLOCK];
            EACH_ROW(
                const real dy = block_y + k - mean_y;
                raw[k] = excess_x + dy * (c * dy - shear);
                live[k] = TO_MASK(raw[k] >= 0) & TO_MASK(latest[r0 + k] >= (mask16)i);)
            if (!any16(live[0] | live[1] | live[2] | live[3]))
                continue;
            EACH_ROW(
                raw[k] = alpha_of(raw[k]);
                alpha[k] = select((real16)0, cut_alpha(raw[k]), live[k]);
                inverse[k] = 1 / (1 - alpha[k]);)
            EACH_ROW(
                const int r = r0 + k;
                const real16 before = t[r] * inverse[k];
                const real16 w = alpha[k] * before;
                real16 light;
                ADD_CHANNELS(light, LIGHT);
                IF_DEPTH(light += grad_z[r] * splat[SPLAT_DEPTH]; s_z += w * grad_z[r];)
                EACH_CHANNEL(s_colour[channel] += w * grad[channel][r];)
                const real16 contrast = light - behind[r];
                const real16 grad_power = GRAD_POWER;
                const real dy = block_y + k - mean_y;
                const real16 grad_dy = grad_power * dy;
                s_p += grad_power;
                s_y += grad_dy;
                s_yy += grad_dy * dy;
                behind[r] += alpha[k] * contrast;
                t[r] = before;)
        }
        // in the order of splat.h; alpha is the opacity times exp(power)
        vstore8(sum16_each(s_p * (1 / splat[SPLAT_OPACITY]), s_p * dx, s_y, s_p * dx * dx, s_y * dx,
                           s_yy, s_colour[0], s_colour[1]), 0, sum);
        for (int j = 2; j < COLOUR_SUMS; j++)
            sum[SUM_COLOUR + j] = sum16(s_colour[j]);
        IF_DEPTH(sum[SUM_DEPTH] = sum16(s_z);)
    }
}
