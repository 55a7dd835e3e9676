// Item form of compact.cl (see there): a work-item owns a chunk.
__kernel void compact(uint count, uint chunk, uint room, __global const uint *restrict flags,
                      __global const uint *restrict totals, __global uint *restrict kept,
                      __global uint *restrict counts)
{
    const uint own = get_global_id(0), begin = own * chunk, end = min(begin + chunk, count);
    if (begin >= count)
        return;
    uint place = 0;
    for (uint i = 0; i < own; i++)
        place += totals[i];
    for (uint i = begin; i < end; i++) {
        if (flags[i]) {
            if (place < room)
                kept[place] = i;
            place++;
        }
    }
    if (end == count)
        set_visible(counts, place, room);
}
