// Item form of scan.cl (see there): a work-item owns a chunk.
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
