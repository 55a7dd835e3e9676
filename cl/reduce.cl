// Column sums of rows in a fixed order: totals[c] = sum_i rows[i, c]. rows: real[N, width].
// One work-group of GROUP items a column: each sums every GROUP-th row, then a fixed tree adds them.
#include "real.h"
#include "group.h"
DEFINE_GROUP_SUM(group_sum, real)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sum_columns(uint count, uint width, __global const real *restrict rows,
                 __global real *restrict totals)
{
    __local real scratch[GROUP];
    const uint lane = get_local_id(0), column = get_group_id(0);
    real sum = 0;
    for (ulong i = lane; i < count; i += GROUP)
        sum += rows[i * width + column];
    const real total = group_sum(sum, scratch);
    if (lane == 0)
        totals[column] = total;
}
