// Group form of contribution.cl (see there): a group owns a tile, a lane a pixel; each splat is
// summed over the group in a fixed tree.
#define GROUP (TILE * TILE)
#include "group.h"
DEFINE_GROUP_SUM(group_sum4, real4)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void contribution(int width, int height, int tiles_x, int first_tile,
                  __global const uint *restrict ranges, __global const uint *restrict sorted_splats,
                  __global const uint *restrict emission_indices,
                  __global const real *restrict splats,
                  __global const int *restrict last_contributor,
                  __global const real *restrict weights, __global real *restrict sums)
{
    __local real4 scratch[GROUP];
    const int tile = get_group_id(0), lane = get_local_id(0), place = first_tile + tile;
    const int column = place % tiles_x * TILE + lane % TILE;
    const int row = place / tiles_x * TILE + lane / TILE;
    const bool inside = column < width && row < height;
    const long pixel = (long)row * width + column;
    const int begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const int latest = inside ? last_contributor[pixel] : -1;
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
            const real w = cut_alpha(s.z * exp2_where(true, power * (real)LOG2_E)) * t;
            t -= w;
            own = (real4)(1, w, w * weight, sqrt(dx * dx + dy * dy));
        }
        const real4 total = group_sum4(own, scratch);
        if (lane == 0)
            vstore4(total, emission_indices[i], sums);
    }
}
