// Column sums of rows in a fixed order: totals[c] = sum_i rows[i, c]. rows: real[N, width].
// One work-group of GROUP items a column; the order does not depend on GROUP.
// add_to: totals[i] += values[i], each of them by itself.
#include "real.h"
#define GROUP SCAN_GROUP
#include "group.h"
#include "each.h"
DEFINE_LANE_SUM(lane_sum, real)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sum_columns(uint count, uint width, __global const real *restrict rows,
                 __global real *restrict totals)
{
    __local real scratch[LANES];
    const uint column = get_group_id(0);
    real sums[GROUP_LANES];
    for (uint own = 0; own < GROUP_LANES; own++)
        sums[own] = 0;
    FOR_LANES(i, own, count)
        sums[own] += rows[(ulong)i * width + column];
    const real total = lane_sum(sums, scratch);
    if (get_local_id(0) == 0)
        totals[column] = total;
}

__kernel void add_to(uint count, __global const real *restrict values,
                     __global real *restrict totals)
{
    FOR_EACH(i, count)
        totals[i] += values[i];
}
