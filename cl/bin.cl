// Pairs of tile and splat. Splats stay in the order of the gaussians' rows, where reading and writing
// them is cheap; `order`, uint[V], lists them front to back, and pairs are emitted in that order. So a
// stable sort of the pairs by tile leaves every tile's pairs in depth order, and a splat's pairs are
// contiguous in the order of emission.
//
// Only tiles [first_tile, end_tile), numbered row by row, are inspected: all of a frame, or a band of
// it (clsplat/rendering/bands.py). Within a band tiles are numbered from its first.
//
// counts: uint[V], tiles the v-th splat from the front touches; offsets: their exclusive scan;
// pair_tiles, pair_splats: uint[P] in the order of emission; a pair's place there is its emission
// index. One writer each: deterministic.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "tiles.h"

// Rows of tiles [*begin, *end) in which the ellipse can reach the band.
inline void band_rows(Ellipse e, int tiles_x, int first_tile, int end_tile, int *begin, int *end)
{
    tile_rows(e, (end_tile + tiles_x - 1) / tiles_x, begin, end);
    *begin = max(*begin, first_tile / tiles_x);
}

// Tiles [*begin, *end) of the band that the ellipse touches in a row; none where *end <= *begin.
inline void band_tiles(Ellipse e, int row, int tiles_x, int first_tile, int end_tile, int *begin,
                       int *end)
{
    tile_columns(e, row, tiles_x, begin, end);
    *begin = max(row * tiles_x + *begin, first_tile);
    *end = min(row * tiles_x + *end, end_tile);
}

__kernel void count_pairs(uint count, int tiles_x, int first_tile, int end_tile,
                          __global const uint *restrict order, __global const real *restrict splats,
                          __global uint *restrict counts)
{
    FOR_EACH(v, count) {
        const Ellipse e = ellipse_of(splats + (ulong)order[v] * SPLAT_REALS);
        int row, row_end, tile, tile_end;
        uint touched = 0;
        band_rows(e, tiles_x, first_tile, end_tile, &row, &row_end);
        for (; row < row_end; row++) {
            band_tiles(e, row, tiles_x, first_tile, end_tile, &tile, &tile_end);
            touched += max(0, tile_end - tile);
        }
        counts[v] = touched;
    }
}

// How many splats begin to touch tiles at each tile, less those that end there: the pairs of each
// tile are the running sums, in uint arithmetic. steps: uint[tiles + 1], zero before. Integer sums:
// the order of the atomics does not matter.
__kernel void count_tiles(uint count, int tiles_x, int tiles_y,
                          __global const real *restrict splats, __global uint *restrict steps)
{
    FOR_EACH(i, count) {
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

__kernel void emit_pairs(uint count, int tiles_x, int first_tile, int end_tile,
                         __global const uint *restrict order, __global const real *restrict splats,
                         __global uint *restrict counts, __global const uint *restrict offsets,
                         __global uint *restrict pair_tiles, __global uint *restrict pair_splats)
{
    FOR_EACH(v, count) {
        const Ellipse e = ellipse_of(splats + (ulong)order[v] * SPLAT_REALS);
        uint index = offsets[v];
        const uint end = index + counts[v];
        int row, row_end, tile, tile_end;
        band_rows(e, tiles_x, first_tile, end_tile, &row, &row_end);
        for (; row < row_end; row++) {
            band_tiles(e, row, tiles_x, first_tile, end_tile, &tile, &tile_end);
            for (; tile < tile_end && index < end; tile++, index++) {
                pair_tiles[index] = tile - first_tile;
                pair_splats[index] = order[v];
            }
        }
        // should a compiler ever round the two walks differently: no index stays unwritten, and
        // only those emitted are summed
        counts[v] = index - offsets[v];
        for (; index < end; index++) {
            pair_tiles[index] = end_tile - first_tile;
            pair_splats[index] = order[v];
        }
    }
}

// After the sort: where each tile's pairs begin and end (ranges: uint[tiles, 2], zero before), and
// the splat of each sorted pair.
__kernel void find_ranges(uint count, uint tiles, __global const uint *restrict sorted_tiles,
                          __global const uint *restrict emission_indices,
                          __global const uint *restrict pair_splats, __global uint *restrict ranges,
                          __global uint *restrict sorted_splats)
{
    FOR_EACH(i, count) {
        const uint tile = sorted_tiles[i];
        sorted_splats[i] = pair_splats[emission_indices[i]];
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
