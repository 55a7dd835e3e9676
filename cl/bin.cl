// Pairs of tile and splat, sorted by tile and then front to back, ties by row.
//
// Splats stay in the order of the gaussians' rows, where reading and writing them is cheap. A
// splat's pairs have consecutive emission indices, in the order of its tiles: offsets[v] is the
// first, splat_counts[v] their number. ranges: uint[tiles, 2], where the pairs of each tile begin
// and end in sorted_splats and emission_indices, uint[P]. Only tiles [first_tile, end_tile),
// numbered row by row, are inspected: all of a frame, or a band of it (clsplat/rendering/blend.py).
// Within a band tiles are numbered from its first.
//
// Three steps: count_pairs counts the pairs of each splat and tile; place_pairs finds where each
// tile's pairs and each chunk's emission indices begin; emit_pairs writes them. The item form emits
// in depth order (sort.cl), each work-item into its own part of each tile's range. The group form
// emits in any order, and sort_tiles sorts each tile's pairs by a unique key, (depth, emission
// index). So both have one order, whatever the order of the atomics.
//
// P is an upper bound that the host expects. Where there are more pairs, the frame FAILS
// (counts.h): it has no pairs, and no visible gaussians from then on.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "tiles.h"
#include "counts.h"

// Rows of tiles [*begin, *end) in which the ellipse can reach the band.
INLINE void band_rows(Ellipse e, int tiles_x, int first_tile, int end_tile, int *begin, int *end)
{
    tile_rows(e, (end_tile + tiles_x - 1) / tiles_x, begin, end);
    *begin = max(*begin, first_tile / tiles_x);
}

// Tiles [*begin, *end) of the band that the ellipse touches in a row; none where *end <= *begin.
INLINE void band_tiles(Ellipse e, int row, int tiles_x, int first_tile, int end_tile, int *begin,
                       int *end)
{
    tile_columns(e, row, tiles_x, begin, end);
    *begin = max(row * tiles_x + *begin, first_tile);
    *end = min(row * tiles_x + *end, end_tile);
}

// Note the number of pairs, by one work-item. Whether the frame has failed, now or before.
inline bool set_pairs(__global uint *counts, ulong number, uint room)
{
    if (number > room)
        note_failure(counts, COUNT_NEEDED_PAIRS, (uint)min(number, (ulong)UINT_MAX));
    const bool failed = counts[COUNT_FAILED];
    const uint pairs = failed ? 0 : (uint)number;
    counts[COUNT_PAIRS] = pairs;
    counts[COUNT_MOST_PAIRS] = max(counts[COUNT_MOST_PAIRS], (uint)min(number, (ulong)UINT_MAX));
    if (failed)
        counts[COUNT_VISIBLE] = 0;
    add_long(counts + COUNT_SUM_PAIRS, pairs);
    return failed;
}

#if FORM_ITEM
#include "item/bin.cl"
#else
#include "group/bin.cl"
#endif

// How many splats begin to touch tiles at each tile, less those that end there: the pairs of each
// tile are the running sums, in uint arithmetic. steps: uint[tiles + 1], zero before. Integer sums:
// the order of the atomics does not matter.
__kernel void count_tiles(int tiles_x, int tiles_y, __global const uint *restrict counts,
                          __global const real *restrict splats, __global uint *restrict steps)
{
    FOR_EACH(i, counts[COUNT_VISIBLE]) {
        const Ellipse e = ellipse_of(splats + i * SPLAT_REALS);
        int row, row_end, column, column_end;
        tile_rows(e, tiles_y, &row, &row_end);
        for (; row < row_end; row++) {
            tile_columns(e, row, tiles_x, &column, &column_end);
            if (column < column_end) {
                atomic_inc(&steps[row * tiles_x + column]);
                atomic_dec(&steps[row * tiles_x + column_end]);
            }
        }
    }
}
