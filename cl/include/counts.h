// The numbers of a frame that only the device knows while it works: counts, uint[FRAME_COUNTS].
// Their places are in clsplat/constants.py. COUNT_FAILED is sticky: from the kernel that meets an
// array that is too small until the host has enlarged it, no kernel changes what outlives a frame.
#if COUNT_SUM_PAIRS + 2 > FRAME_COUNTS
#error "the counts do not fit"
#endif

inline void note_failure(__global uint *counts, uint what, uint needed)
{
    counts[COUNT_FAILED] = 1;
    counts[what] = max(counts[what], needed);
}

// Add to a sum of 64 bits in two words, low first; by one work-item.
inline void add_long(__global uint *words, ulong value)
{
    const ulong sum = ((ulong)words[1] << 32 | words[0]) + value;
    words[0] = (uint)sum;
    words[1] = (uint)(sum >> 32);
}
