// What a work-item of the item form will soon read, asked for while it computes: rows that are far
// apart in memory arrive a hundred times as late as those of the cache.
#define AHEAD 4 // rows before its turn that a row is asked for
#if HAVE_PREFETCH
#define PREFETCH(P) __builtin_prefetch((const void *)(size_t)(P))
#else
#define PREFETCH(P)
#endif
#define LINE_OF(P) (64 / sizeof(*(P))) // elements in a line of the cache

// NUMBER neighbouring elements, which may begin within a line and end in one more.
#define PREFETCH_SPAN(P, NUMBER)                                                                   \
    {                                                                                              \
        for (int offset = 0; offset < (int)(NUMBER); offset += LINE_OF(P))                         \
            PREFETCH((P) + offset);                                                                \
        PREFETCH((P) + (NUMBER)-1);                                                                \
    }
#define PREFETCH_ROW(P, ROW, WIDTH) PREFETCH_SPAN((P) + (ulong)(ROW) * (WIDTH), WIDTH)

// All parameters of a gaussian, whose harmonics are in row `rest` (rest.h).
inline void prefetch_gaussian(uint row, ulong rest, __global const real *positions,
                              __global const real *sh_constant, __global const real *sh_rest,
                              __global const real *opacity_logits, __global const real *log_scales,
                              __global const real *quaternions)
{
    PREFETCH(positions + 3ul * row);
    PREFETCH(sh_constant + 3ul * row);
    PREFETCH(opacity_logits + row);
    PREFETCH(log_scales + 3ul * row);
    PREFETCH(quaternions + 4ul * row);
#if DEGREE > 0
    PREFETCH_ROW(sh_rest, rest, 3 * SH_REST);
#endif
}
