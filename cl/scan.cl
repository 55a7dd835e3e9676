// Exclusive prefix sum of uint values, reduce-then-scan in chunks; integer, hence deterministic.
//
//   offsets[i] = values[0] + ... + values[i-1]
//   totals[c] = sum of chunk c, totals[chunks] = sum of all, in 64 bits
//
// values, offsets: uint[N]; totals: ulong[chunks + 1]. Every chunk adds up the totals before it:
// that takes less than one more launch. Offsets are 32-bit: the caller must refuse a total past
// 2^32. Item form: a work-item owns a chunk. Group form: a group of GROUP owns one.

#if FORM_ITEM

__kernel void scan_reduce(uint count, uint chunk, __global const uint *restrict values,
                          __global ulong *restrict totals)
{
    const uint begin = get_global_id(0) * chunk, end = min(begin + chunk, count);
    if (begin >= count)
        return;
    ulong sum = 0;
    for (uint i = begin; i < end; i++)
        sum += values[i];
    totals[get_global_id(0)] = sum;
}

__kernel void scan_apply(uint count, uint chunk, __global const uint *restrict values,
                         __global ulong *restrict totals, __global uint *restrict offsets)
{
    const uint own = get_global_id(0), begin = own * chunk, end = min(begin + chunk, count);
    if (begin >= count)
        return;
    ulong sum = 0;
    for (uint i = 0; i < own; i++)
        sum += totals[i];
    if (end == count)
        totals[own + 1] = sum + totals[own];
    uint offset = (uint)sum;
    for (uint i = begin; i < end; i++) {
        const uint value = values[i]; // read first: offsets may be the same memory
        offsets[i] = offset;
        offset += value;
    }
}

#else

#include "group.h"
DEFINE_GROUP_SCAN(group_scan_ulong, ulong)
#define PER_ITEM 8 // a chunk is GROUP * PER_ITEM values

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void scan_reduce(uint count, uint chunk, __global const uint *restrict values,
                 __global ulong *restrict totals)
{
    __local ulong scratch[GROUP];
    const uint begin = get_group_id(0) * chunk, end = min(begin + chunk, count);
    ulong sum = 0, total;
    for (uint i = begin + get_local_id(0); i < end; i += GROUP)
        sum += values[i];
    group_scan_ulong(sum, scratch, &total);
    if (get_local_id(0) == 0)
        totals[get_group_id(0)] = total;
}

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void scan_apply(uint count, uint chunk, __global const uint *restrict values,
                __global ulong *restrict totals, __global uint *restrict offsets)
{
    __local ulong scratch[GROUP];
    const uint begin = get_group_id(0) * chunk + get_local_id(0) * PER_ITEM;
    uint own[PER_ITEM];
    ulong sum = 0, before, total;
    FOR_GROUP(i, get_group_id(0))
        sum += totals[i];
    group_scan_ulong(sum, scratch, &before);
    sum = 0;
    for (uint j = 0; j < PER_ITEM; j++) {
        own[j] = begin + j < count ? values[begin + j] : 0;
        sum += own[j];
    }
    uint offset = (uint)(before + group_scan_ulong(sum, scratch, &total));
    if (get_group_id(0) == get_num_groups(0) - 1 && get_local_id(0) == 0)
        totals[get_num_groups(0)] = before + total;
    for (uint j = 0; j < PER_ITEM; j++) {
        if (begin + j < count)
            offsets[begin + j] = offset;
        offset += own[j];
    }
}

#endif
