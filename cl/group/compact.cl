// Group form of compact.cl (see there): a group owns a chunk of GROUP * PER_ITEM rows.
CHUNK_KERNEL
void compact(uint count, uint chunk, uint room, __global const uint *restrict flags,
             __global const uint *restrict totals, __global uint *restrict kept,
             __global uint *restrict counts)
{
    CHUNK_SCRATCH
    const uint begin = CHUNK_INDEX * chunk + get_local_id(0) * PER_ITEM;
    uint own[PER_ITEM], sum = 0, total;
    FOR_GROUP(i, CHUNK_INDEX)
        sum += totals[i];
    const uint before = group_total(sum, chunk_scratch);
    sum = 0;
    for (uint j = 0; j < PER_ITEM; j++) {
        own[j] = begin + j < count ? flags[begin + j] : 0;
        sum += own[j];
    }
    uint place = before + group_scan(sum, chunk_scratch, &total);
    for (uint j = 0; j < PER_ITEM; j++) {
        if (own[j]) {
            if (place < room)
                kept[place] = begin + j;
            place++;
        }
    }
    if (CHUNK_LEADS && CHUNK_INDEX * chunk + chunk >= count)
        set_visible(counts, before + total, room);
}
