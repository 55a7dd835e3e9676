// Group form of exposure.cl (see there): a group owns a block.
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_LANE_SUM(lane_sum, real)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void exposure_adjoint(EXPOSURE_ADJOINT_ARGUMENTS)
{
    __local real scratch[LANES];
    const ulong block = get_group_id(0), begin = block * EXPOSURE_BLOCK;
    Response response;
    LOAD_RESPONSE(response);
    real sums[GROUP_LANES][RESPONSE_TERMS], lanes[GROUP_LANES];
    for (int k = 0; k < RESPONSE_TERMS; k++) {
        for (uint own = 0; own < GROUP_LANES; own++)
            sums[own][k] = 0;
    }
    FOR_LANES(i, own, min((ulong)EXPOSURE_BLOCK, pixels - begin)) {
        pixels1(pixels, begin + i, &response, RADIUS_OF_ONE(begin + i), image, grad, grad_image,
                sums[own]);
    }
    for (int k = 0; k < RESPONSE_TERMS; k++) {
        for (uint own = 0; own < GROUP_LANES; own++)
            lanes[own] = sums[own][k];
        const real total = lane_sum(lanes, scratch);
        if (get_local_id(0) == 0)
            partials[block * RESPONSE_TERMS + k] = total;
    }
}
