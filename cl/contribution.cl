// What each splat contributed to a frame, over the pixels where it was blended:
//
//   pixel count,  sum alpha T,  sum alpha T weight,  sum of the distance from its mean (pixels)
//
// weights: real[H, W], any image. Alpha and the skip rule are those of blend.cl; where pixels ended
// is read from its `last`: int[H, W]. splats: real[V, SPLAT_REALS]; ranges: uint[tiles, 2] into
// sorted_splats and slots: uint[P]. Sums of a pair go to its slot, real4[P], one writer each.
//
// Item form: a work-item owns a tile; a row of 16 pixels is one vector. Group form: a group owns a
// tile, a lane a pixel; each splat is summed over the group in a fixed tree. This runs on a few views
// at a round of growth, so it is kept simple.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "footprint.h"

#if FORM_ITEM
#define IOTA (real16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void contribution(int width, int height, int tiles_x, int first_tile,
                  __global const uint *restrict ranges, __global const uint *restrict sorted_splats,
                  __global const uint *restrict slots, __global const real *restrict splats,
                  __global const int *restrict last, __global const real *restrict weights,
                  __global real *restrict sums)
{
    const int tile = get_global_id(0), place = first_tile + tile;
    const int x0 = place % tiles_x * TILE, y0 = place / tiles_x * TILE;
    const int columns = min(TILE, width - x0), rows = min(TILE, height - y0);
    const int begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const real16 x = IOTA + (real)(x0 + 0.5);
    const real first_y = y0 + 0.5;
    real16 t[TILE], weight[TILE];
    mask16 latest[TILE];
    for (int r = 0; r < rows; r++) {
        real values[16];
        int indices[16];
        for (int i = 0; i < 16; i++) {
            const long pixel = (long)(y0 + r) * width + x0 + i;
            values[i] = i < columns ? weights[pixel] : 0;
            indices[i] = i < columns ? last[pixel] : -1;
        }
        t[r] = 1;
        weight[r] = vload16(0, values);
        latest[r] = convert_mask16(vload16(0, indices));
    }
    for (int i = begin; i < end; i++) {
        __global const real *splat = splats + (ulong)sorted_splats[i] * SPLAT_REALS;
        const real cut = -0.5 * splat[SPLAT_CUTOFF], opacity = splat[SPLAT_OPACITY];
        const real a = -0.5 * splat[SPLAT_CONIC], b = splat[SPLAT_CONIC + 1];
        const real c = -0.5 * splat[SPLAT_CONIC + 2], mean_y = splat[SPLAT_MEAN + 1];
        const real16 dx = x - splat[SPLAT_MEAN];
        const real16 power_x = a * dx * dx, shear = b * dx, zero = 0;
        real16 s_pixels = 0, s_weight = 0, s_weighted = 0, s_distance = 0;
        for (int r = 0; r < rows; r++) {
            const real dy = first_y + r - mean_y;
            const real16 power = power_x + dy * (c * dy - shear);
            const mask16 live = TO_MASK(power >= cut) & TO_MASK(latest[r] >= (mask16)i);
            if (!any16(live))
                continue;
            const real16 w = select(zero, cut_alpha(opacity * exp_power(power)) * t[r], live);
            t[r] -= w;
            s_pixels += select(zero, (real16)1, live);
            s_weight += w;
            s_weighted += select(zero, w * weight[r], live); // a weight may be nan elsewhere
            s_distance += select(zero, sqrt(dx * dx + dy * dy), live);
        }
        vstore4((real4)(sum16(s_pixels), sum16(s_weight), sum16(s_weighted), sum16(s_distance)),
                slots[i], sums);
    }
}
#else
#include "group.h"
DEFINE_GROUP_SUM(group_sum4, real4)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void contribution(int width, int height, int tiles_x, int first_tile,
                  __global const uint *restrict ranges, __global const uint *restrict sorted_splats,
                  __global const uint *restrict slots, __global const real *restrict splats,
                  __global const int *restrict last, __global const real *restrict weights,
                  __global real *restrict sums)
{
    __local real4 scratch[GROUP];
    const int tile = get_group_id(0), lane = get_local_id(0), place = first_tile + tile;
    const int column = place % tiles_x * TILE + lane % TILE;
    const int row = place / tiles_x * TILE + lane / TILE;
    const bool inside = column < width && row < height;
    const long pixel = (long)row * width + column;
    const int begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const int latest = inside ? last[pixel] : -1;
    const real weight = inside ? weights[pixel] : 0;
    const real x = column + 0.5, y = row + 0.5;
    real t = 1;
    for (int i = begin; i < end; i++) {
        __global const real *splat = splats + (ulong)sorted_splats[i] * SPLAT_REALS;
        const real4 s = vload4(0, splat), k = vload4(1, splat);
        const real dx = x - s.x, dy = y - s.y;
        const real power = -0.5 * (k.x * dx * dx + k.z * dy * dy) - k.y * dx * dy;
        real4 own = (real4)(0);
        if (i <= latest && power >= -0.5 * s.w) {
            const real w = cut_alpha(s.z * exp_power(power)) * t;
            t -= w;
            own = (real4)(1, w, w * weight, sqrt(dx * dx + dy * dy));
        }
        const real4 total = group_sum4(own, scratch);
        if (lane == 0)
            vstore4(total, slots[i], sums);
    }
}
#endif

// Sums of each splat over its pairs, in slot order: totals[order[v]] from the rows of `sums` that
// begin at offsets[v]. carried: go on from what earlier bands left in `totals`.
__kernel void sum_contributions(uint count, uint carried,
                                __global const uint *restrict order,
                                __global const uint *restrict counts,
                                __global const uint *restrict offsets,
                                __global const real *restrict sums, __global real *restrict totals)
{
    FOR_EACH(v, count) {
        real4 total = carried ? vload4(order[v], totals) : (real4)(0);
        const ulong begin = offsets[v], end = begin + counts[v];
        for (ulong slot = begin; slot < end; slot++)
            total += vload4(slot, sums);
        vstore4(total, order[v], totals);
    }
}
