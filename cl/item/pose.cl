// Item form of pose.cl (see there): a work-item walks blocks.
__kernel void pose_sums(uint rows, uint blocks, __global const uint *restrict counts,
                        __global const real *restrict pose_terms, __global real *restrict partials)
{
    const ulong count = min(rows, counts[COUNT_VISIBLE]);
    FOR_EACH(block, blocks) {
        const ulong begin = block * POSE_BLOCK, end = min(begin + POSE_BLOCK, count);
        real3 by_turn = (real3)(0), by_position = (real3)(0);
        for (ulong i = begin; i < end; i++) {
            by_turn += vload3(2 * i, pose_terms);
            by_position += vload3(2 * i + 1, pose_terms);
        }
        vstore3(by_turn, 2 * block, partials);
        vstore3(by_position, 2 * block + 1, partials);
    }
}
