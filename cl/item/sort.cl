// Item form of sort.cl (see there): a work-item walks its chunk in order.
__kernel void sort_count(uint count, uint chunk, uint chunks, uint shift,
                         __global const uint *restrict keys, __global uint *restrict table)
{
    const uint own = get_global_id(0);
    const uint begin = own * chunk, end = min(begin + chunk, count);
    if (own >= chunks)
        return;
    uint digits[DIGITS];
    for (uint d = 0; d < DIGITS; d++)
        digits[d] = 0;
    for (uint i = begin; i < end; i++)
        digits[DIGIT(keys[i])]++;
    for (uint d = 0; d < DIGITS; d++)
        table[d * chunks + own] = digits[d];
}

__kernel void sort_scatter(uint count, uint chunk, uint chunks, uint shift, uint first,
                           __global const uint *restrict keys, __global const uint *restrict values,
                           __global const uint *restrict table, __global uint *restrict sorted_keys,
                           __global uint *restrict sorted_values)
{
    const uint own = get_global_id(0);
    const uint begin = own * chunk, end = min(begin + chunk, count);
    if (own >= chunks)
        return;
    uint next[DIGITS];
    for (uint d = 0; d < DIGITS; d++)
        next[d] = table[d * chunks + own];
    for (uint i = begin; i < end; i++) {
        const uint key = keys[i], slot = next[DIGIT(key)]++;
        sorted_keys[slot] = key;
        sorted_values[slot] = first ? i : values[i];
    }
}
