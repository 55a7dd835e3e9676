// Group form of reproject.cl (see there): a group owns a row.
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_LANE_SUM(lane_sum, real2)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void reproject(REPROJECT_ARGUMENTS)
{
    __local real2 scratch[LANES];
    const int row = get_group_id(0);
    real2 sums[GROUP_LANES];
    for (uint lane = 0; lane < GROUP_LANES; lane++)
        sums[lane] = (real2)(0);
    FOR_LANES(x, own, (uint)width) {
        const long pixel = (long)row * width + x;
        real2 grads;
        sums[own] += reproject_pixel(
            x, row, width, height, neighbour_width, neighbour_height, depth[pixel],
            transmittance[pixel], photo, neighbour, geometries + GEOMETRY_REALS * (ulong)pair,
            colours + TRANSFORM_REALS * (ulong)pair, &grads);
        grad_depth[pixel] = grads.x;
        grad_transmittance[pixel] = grads.y;
    }
    const real2 total = lane_sum(sums, scratch);
    if (get_local_id(0) == 0)
        vstore2(total, row, partials);
}
