// Group form of scan.cl (see there): a group owns a chunk of GROUP * PER_ITEM values.
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_GROUP_SCAN(group_scan_ulong, ulong)

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
