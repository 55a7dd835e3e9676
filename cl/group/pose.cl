// Group form of pose.cl (see there): a group owns a block.
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_LANE_SUM(lane_sum, real)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void pose_sums(uint rows, uint blocks, __global const uint *restrict counts,
               __global const real *restrict pose_terms, __global real *restrict partials)
{
    __local real scratch[LANES];
    const uint count = min(rows, counts[COUNT_VISIBLE]);
    const ulong block = get_group_id(0), begin = block * POSE_BLOCK;
    real sums[POSE_REALS][GROUP_LANES];
    for (int k = 0; k < POSE_REALS; k++)
        for (uint own = 0; own < GROUP_LANES; own++)
            sums[k][own] = 0;
    if (begin < count) {
        FOR_LANES(i, own, min((ulong)POSE_BLOCK, count - begin)) {
            for (int k = 0; k < POSE_REALS; k++)
                sums[k][own] += pose_terms[(begin + i) * POSE_REALS + k];
        }
    }
    for (int k = 0; k < POSE_REALS; k++) {
        const real total = lane_sum(sums[k], scratch);
        if (get_local_id(0) == 0)
            partials[block * POSE_REALS + k] = total;
    }
}
