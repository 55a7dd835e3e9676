// Pairs of tile and splat. Splats stay in the order of the gaussians' rows, where reading and writing
// them is cheap; `order`, uint[V], lists them front to back, and pairs are emitted in that order. So a
// stable sort of the pairs by tile leaves every tile's pairs in depth order, and a splat's pairs are
// contiguous (its slots).
//
// counts: uint[V], tiles the v-th splat from the front touches; offsets: their exclusive scan;
// pair_tiles, pair_splats: uint[P] in emission order (a pair's index there is its slot). One writer a
// slot: deterministic.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "tiles.h"

__kernel void count_pairs(uint count, int tiles_x, int tiles_y, __global const uint *restrict order,
                          __global const real *restrict splats, __global uint *restrict counts)
{
    FOR_EACH(v, count) {
        const Ellipse e = ellipse_of(splats + (ulong)order[v] * SPLAT_REALS);
        int row, row_end, column, column_end;
        uint touched = 0;
        tile_rows(e, tiles_y, &row, &row_end);
        for (; row < row_end; row++) {
            tile_columns(e, row, tiles_x, &column, &column_end);
            touched += max(0, column_end - column);
        }
        counts[v] = touched;
    }
}

__kernel void emit_pairs(uint count, int tiles_x, int tiles_y, __global const uint *restrict order,
                         __global const real *restrict splats, __global uint *restrict counts,
                         __global const uint *restrict offsets,
                         __global uint *restrict pair_tiles, __global uint *restrict pair_splats)
{
    FOR_EACH(v, count) {
        const Ellipse e = ellipse_of(splats + (ulong)order[v] * SPLAT_REALS);
        uint slot = offsets[v];
        const uint end = slot + counts[v];
        int row, row_end, column, column_end;
        tile_rows(e, tiles_y, &row, &row_end);
        for (; row < row_end; row++) {
            tile_columns(e, row, tiles_x, &column, &column_end);
            for (; column < column_end && slot < end; column++, slot++) {
                pair_tiles[slot] = row * tiles_x + column;
                pair_splats[slot] = order[v];
            }
        }
        // should a compiler ever round the two walks differently: no slot stays unwritten, and
        // only those emitted are summed
        counts[v] = slot - offsets[v];
        for (; slot < end; slot++) {
            pair_tiles[slot] = tiles_x * tiles_y;
            pair_splats[slot] = order[v];
        }
    }
}

// After the sort: where each tile's pairs begin and end (ranges: uint[tiles, 2], zero before), and
// the splat of each sorted pair.
__kernel void find_ranges(uint count, uint tiles, __global const uint *restrict sorted_tiles,
                          __global const uint *restrict slots,
                          __global const uint *restrict pair_splats, __global uint *restrict ranges,
                          __global uint *restrict sorted_splats)
{
    FOR_EACH(i, count) {
        const uint tile = sorted_tiles[i];
        sorted_splats[i] = pair_splats[slots[i]];
        if (tile >= tiles)
            continue;
        if (i == 0 || sorted_tiles[i - 1] != tile)
            ranges[2 * tile] = i;
        if (i == count - 1 || sorted_tiles[i + 1] != tile)
            ranges[2 * tile + 1] = i + 1;
    }
}

// Buckets of BUCKET consecutive pairs of one tile, for the group form's adjoint.
__kernel void count_buckets(uint tiles, __global const uint *restrict ranges,
                            __global uint *restrict counts)
{
    FOR_EACH(tile, tiles)
        counts[tile] = (ranges[2 * tile + 1] - ranges[2 * tile] + BUCKET - 1) / BUCKET;
}

// bucket_tiles: uint[B]; entries past the last bucket keep the value `tiles` they were filled with.
__kernel void fill_buckets(uint tiles, __global const uint *restrict counts,
                           __global const uint *restrict offsets,
                           __global uint *restrict bucket_tiles)
{
    FOR_EACH(tile, tiles) {
        for (uint i = 0; i < counts[tile]; i++)
            bucket_tiles[offsets[tile] + i] = tile;
    }
}
