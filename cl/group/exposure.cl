// Group form of exposure.cl (see there): a group owns a block.
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_LANE_SUM(lane_sum, real)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void exposure_adjoint(uint pixels, uint width, uint view, uint blocks,
                      __global const real *restrict camera,
                      __global const real *restrict transforms,
                      __global const uint *restrict lens_of, __global const real *restrict lenses,
                      __global const real *restrict image, __global const real *restrict grad,
                      __global const uchar *restrict layers, __global real *restrict grad_image,
                      __global real *restrict partials)
{
    __local real scratch[LANES];
    const ulong block = get_group_id(0), begin = block * EXPOSURE_BLOCK;
    __global const real *lens = lenses + lens_of[view] * VIGNETTING_REALS;
    real e[TRANSFORM_REALS], sums[GROUP_LANES][EXPOSURE_SUMS], lanes[GROUP_LANES];
    for (int k = 0; k < TRANSFORM_REALS; k++)
        e[k] = transforms[view * TRANSFORM_REALS + k];
    for (int k = 0; k < EXPOSURE_SUMS; k++) {
        for (uint own = 0; own < GROUP_LANES; own++)
            sums[own][k] = 0;
    }
    FOR_LANES(i, own, min((ulong)EXPOSURE_BLOCK, pixels - begin)) {
        const ulong p = begin + i;
        pixels1(pixels, e, lens, radius_of1(camera, lens, p, width), image + p, grad + p,
                layers + p, grad_image + p, sums[own]);
    }
    for (int k = 0; k < EXPOSURE_SUMS; k++) {
        for (uint own = 0; own < GROUP_LANES; own++)
            lanes[own] = sums[own][k];
        const real total = lane_sum(lanes, scratch);
        if (get_local_id(0) == 0)
            partials[block * EXPOSURE_SUMS + k] = total;
    }
}
