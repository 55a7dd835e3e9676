// Exclusive prefix sum of uint values, reduce-then-scan in chunks; integer, hence deterministic.
//
//   offsets[i] = values[0] + ... + values[i-1]      totals[chunks] = sum of all, in 64 bits
//
// values, offsets: uint[N]; totals: ulong[chunks + 1]. Offsets are 32-bit: the caller must refuse a
// total past 2^32. Item form: a work-item owns a chunk. Group form: a group of GROUP owns one.

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

__kernel void scan_totals(uint chunks, __global ulong *restrict totals)
{
    if (get_global_id(0) > 0)
        return;
    ulong sum = 0;
    for (uint i = 0; i < chunks; i++) {
        const ulong value = totals[i];
        totals[i] = sum;
        sum += value;
    }
    totals[chunks] = sum;
}

__kernel void scan_apply(uint count, uint chunk, __global const uint *restrict values,
                         __global const ulong *restrict totals, __global uint *restrict offsets)
{
    const uint begin = get_global_id(0) * chunk, end = min(begin + chunk, count);
    if (begin >= count)
        return;
    uint sum = (uint)totals[get_global_id(0)];
    for (uint i = begin; i < end; i++) {
        const uint value = values[i]; // read first: offsets may be the same memory
        offsets[i] = sum;
        sum += value;
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
void scan_totals(uint chunks, __global ulong *restrict totals)
{
    __local ulong scratch[GROUP];
    ulong before = 0;
    for (uint base = 0; base < chunks; base += GROUP) {
        const uint i = base + get_local_id(0);
        const ulong value = i < chunks ? totals[i] : 0;
        ulong total;
        const ulong offset = group_scan_ulong(value, scratch, &total);
        if (i < chunks)
            totals[i] = before + offset;
        before += total;
    }
    if (get_local_id(0) == 0)
        totals[chunks] = before;
}

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void scan_apply(uint count, uint chunk, __global const uint *restrict values,
                __global const ulong *restrict totals, __global uint *restrict offsets)
{
    __local ulong scratch[GROUP];
    const uint begin = get_group_id(0) * chunk + get_local_id(0) * PER_ITEM;
    uint own[PER_ITEM];
    ulong sum = 0, total;
    for (uint j = 0; j < PER_ITEM; j++) {
        own[j] = begin + j < count ? values[begin + j] : 0;
        sum += own[j];
    }
    uint offset = (uint)(totals[get_group_id(0)] + group_scan_ulong(sum, scratch, &total));
    for (uint j = 0; j < PER_ITEM; j++) {
        if (begin + j < count)
            offsets[begin + j] = offset;
        offset += own[j];
    }
}

#endif
