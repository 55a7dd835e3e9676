// Pages of rows that wait in host memory until a view sees one of them (include/rest.h).
//
// flags: uint[N], 1 for the rows of which a page is needed; wanted: uint[pages], 1 for such a page.
// Several rows of a page write the same 1: deterministic.
#include "real.h"
#include "each.h"
#include "counts.h"
#include "rest.h"

__kernel void mark_pages(uint count, __global const uint *restrict flags,
                         __global const uint *restrict places, __global uint *restrict wanted)
{
    FOR_EACH(row, count) {
        if (flags[row])
            wanted[places[row] / PAGE_ROWS] = 1;
    }
}

// A frame that wants a page that is not there fails. clears: whether the next frame wants others.
__kernel void require_pages(uint pages, uint clears, __global const uint *restrict slots,
                            __global uint *restrict wanted, __global uint *restrict counts)
{
    FOR_EACH(page, pages) {
        if (wanted[page] && (slots[page] & PAGE_ABSENT))
            atomic_cmpxchg(counts + COUNT_FAILED, 0, LACKS_PAGE); // an earlier reason stays
        if (clears)
            wanted[page] = 0;
    }
}

// rows: uint[count] -> where the harmonics of each lie.
__kernel void rest_rows(uint count, __global const uint *restrict rows,
                        __global const uint *restrict places, __global const uint *restrict slots,
                        __global uint *restrict lies)
{
    FOR_EACH(i, count)
        lies[i] = (uint)REST_ROW(rows[i]);
}
