// The rows whose flag is 1, in order. Two launches: the totals of all chunks (count_flags, or a
// kernel that makes flags), then each chunk adds up the totals before its own and lists its rows.
//
// flags: uint[N], 0 or 1; totals: uint[chunks]; kept: uint[R], of which the first
// counts[COUNT_VISIBLE] are written; R is an upper bound that the host expects. Where more rows are
// kept than fit, the frame FAILS: nothing is kept, and counts[COUNT_FAILED] stays set, until the
// host has made room and repeats all work since (clsplat/training/units.py). Integer, one writer a
// slot: deterministic.
#include "chunk.h"
#include "counts.h"

CHUNK_KERNEL
void count_flags(uint count, uint chunk, __global const uint *restrict flags,
                 __global uint *restrict totals)
{
    CHUNK_SCRATCH
    const uint begin = CHUNK_INDEX * chunk, end = min(begin + chunk, count);
    uint kept = 0;
    FOR_CHUNK(i, begin, end)
        kept += flags[i];
    const uint total = CHUNK_TOTAL(kept);
    if (CHUNK_LEADS)
        totals[CHUNK_INDEX] = total;
}

// By the last chunk, which knows the number of all rows.
inline void set_visible(__global uint *counts, uint number, uint room)
{
    if (number > room)
        note_failure(counts, COUNT_NEEDED_VISIBLE, number);
    counts[COUNT_MOST_VISIBLE] = max(counts[COUNT_MOST_VISIBLE], number);
    counts[COUNT_VISIBLE] = counts[COUNT_FAILED] ? 0 : number;
}

#if FORM_ITEM
#include "item/compact.cl"
#else
#include "group/compact.cl"
#endif
