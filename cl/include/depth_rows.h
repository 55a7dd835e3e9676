// The kernel of a loss term that compares a view's rendered depth with something, pixel by pixel.
// It writes the sums of a row's pixels to partials, real[H, 2], and the gradients by each pixel's
// depth and T. Item form: a work-item owns a row; group form: a group does. To be defined before:
//
//   NAME       the kernel's name
//   ARGUMENTS  its arguments before grad_depth, among them width
//   PIXEL      real2, what the pixel of column x, `row` and index `pixel` adds to the sums of its
//              row; it sets `grads`, real2, the gradients by the pixel's depth and T
#if FORM_ITEM
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void NAME(ARGUMENTS, __global real *restrict grad_depth, __global real *restrict grad_transmittance,
          __global real *restrict partials)
{
    const int row = get_global_id(0);
    real2 sum = (real2)(0);
    for (int x = 0; x < width; x++) {
        const long pixel = (long)row * width + x;
        real2 grads;
        sum += PIXEL;
        grad_depth[pixel] = grads.x;
        grad_transmittance[pixel] = grads.y;
    }
    vstore2(sum, row, partials);
}
#else
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_LANE_SUM(lane_sum, real2)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void NAME(ARGUMENTS, __global real *restrict grad_depth, __global real *restrict grad_transmittance,
          __global real *restrict partials)
{
    __local real2 scratch[LANES];
    const int row = get_group_id(0);
    real2 sums[GROUP_LANES];
    for (uint lane = 0; lane < GROUP_LANES; lane++)
        sums[lane] = (real2)(0);
    FOR_LANES(x, own, (uint)width) {
        const long pixel = (long)row * width + x;
        real2 grads;
        sums[own] += PIXEL;
        grad_depth[pixel] = grads.x;
        grad_transmittance[pixel] = grads.y;
    }
    const real2 total = lane_sum(sums, scratch);
    if (get_local_id(0) == 0)
        vstore2(total, row, partials);
}
#endif
