// Work-group scan and sum in a fixed order. Every item of the group must call it (it has barriers).
#ifndef GROUP
#error "GROUP, the work-group size, must be defined before"
#endif

// Every i below count once, by all items of the group together; to be followed by a block. The trip
// count is the same for all items: PoCL 5.0 miscompiles loops between barriers where it is not.
#define FOR_GROUP(i, count)                                                                        \
    for (uint i##_base = 0, i = get_local_id(0); i##_base < (count);                               \
         i##_base += GROUP, i = i##_base + get_local_id(0))                                        \
        if (i < (count))

// Exclusive prefix sum of `value` over the group; *total gets the sum. scratch: GROUP elements.
#define DEFINE_GROUP_SCAN(NAME, TYPE)                                                             \
    inline TYPE NAME(TYPE value, __local TYPE *scratch, TYPE *total)                               \
    {                                                                                              \
        const uint lane = get_local_id(0);                                                         \
        TYPE sum = value;                                                                          \
        scratch[lane] = sum;                                                                       \
        barrier(CLK_LOCAL_MEM_FENCE);                                                              \
        for (uint step = 1; step < GROUP; step <<= 1) {                                            \
            TYPE before = lane >= step ? scratch[lane - step] : 0;                                 \
            barrier(CLK_LOCAL_MEM_FENCE);                                                          \
            sum += before;                                                                         \
            scratch[lane] = sum;                                                                   \
            barrier(CLK_LOCAL_MEM_FENCE);                                                          \
        }                                                                                          \
        *total = scratch[GROUP - 1];                                                               \
        barrier(CLK_LOCAL_MEM_FENCE);                                                              \
        return sum - value;                                                                        \
    }

// Sum over the group in a fixed tree, for every item.
#define DEFINE_GROUP_SUM(NAME, TYPE)                                                              \
    inline TYPE NAME(TYPE value, __local TYPE *scratch)                                            \
    {                                                                                              \
        const uint lane = get_local_id(0);                                                         \
        scratch[lane] = value;                                                                     \
        barrier(CLK_LOCAL_MEM_FENCE);                                                              \
        for (uint stride = GROUP / 2; stride > 0; stride >>= 1) {                                  \
            if (lane < stride)                                                                     \
                scratch[lane] += scratch[lane + stride];                                           \
            barrier(CLK_LOCAL_MEM_FENCE);                                                          \
        }                                                                                          \
        const TYPE total = scratch[0];                                                             \
        barrier(CLK_LOCAL_MEM_FENCE);                                                              \
        return total;                                                                              \
    }

// Sums over many, in an order that does not depend on GROUP: lane l of LANES adds up l, l + LANES,
// ..., then a fixed tree the lanes. An item has GROUP_LANES of them, one in groups of 256.
#define GROUP_LANES (LANES / GROUP)

// Every i below count once, by all items of the group together, for the item's own-th lane; to be
// followed by a block. The trip counts are the same for all items.
#define FOR_LANES(i, own, count)                                                                   \
    for (uint i##_base = 0; i##_base < (count); i##_base += LANES)                                 \
        for (uint own = 0, i = i##_base + get_local_id(0); own < GROUP_LANES; own++, i += GROUP)   \
            if (i < (count))

// Sum over all lanes, for every item. values: the item's own lanes; scratch: LANES elements.
#define DEFINE_LANE_SUM(NAME, TYPE)                                                               \
    inline TYPE NAME(const TYPE *values, __local TYPE *scratch)                                    \
    {                                                                                              \
        for (uint own = 0; own < GROUP_LANES; own++)                                               \
            scratch[own * GROUP + get_local_id(0)] = values[own];                                  \
        barrier(CLK_LOCAL_MEM_FENCE);                                                              \
        for (uint stride = LANES / 2; stride > 0; stride >>= 1) {                                  \
            FOR_GROUP(i, stride)                                                                   \
                scratch[i] += scratch[i + stride];                                                 \
            barrier(CLK_LOCAL_MEM_FENCE);                                                          \
        }                                                                                          \
        const TYPE total = scratch[0];                                                             \
        barrier(CLK_LOCAL_MEM_FENCE);                                                              \
        return total;                                                                              \
    }
