// Item form of bin.cl (see there): a work-item counts and emits the splats of its part of the depth
// order. The parts are the rows of `table`, uint[parts, tiles]: first how many pairs each part has
// in each tile, then where they begin in the sorted lists. totals: uint[parts], the pairs of each
// part, or the largest uint where there are more, for which no frame has room.
#include "prefetch.h"

__kernel void count_pairs(int tiles_x, int first_tile, int end_tile,
                          __global const uint *restrict counts,
                          __global const real *restrict splats,
                          __global uint *restrict splat_counts, __global const uint *restrict order,
                          uint parts, __global uint *restrict table, __global uint *restrict totals)
{
    const int tiles = end_tile - first_tile;
    FOR_EACH(part, parts) {
        __global uint *own = table + part * tiles;
        const ulong visible = counts[COUNT_VISIBLE];
        const uint begin = visible * part / parts, end = visible * (part + 1) / parts;
        uint total = 0;
        for (int tile = 0; tile < tiles; tile++)
            own[tile] = 0;
        for (uint i = begin; i < end; i++) {
            const uint v = order[i];
            PREFETCH_ROW(splats, order[min(i + AHEAD, end - 1)], SPLAT_REALS);
            const Ellipse e = ellipse_of(splats + (ulong)v * SPLAT_REALS);
            int row, row_end, tile, tile_end;
            uint touched = 0;
            band_rows(e, tiles_x, first_tile, end_tile, &row, &row_end);
            for (; row < row_end; row++) {
                band_tiles(e, row, tiles_x, first_tile, end_tile, &tile, &tile_end);
                touched += max(0, tile_end - tile);
                for (; tile < tile_end; tile++)
                    own[tile - first_tile]++;
            }
            splat_counts[v] = touched;
            total = add_sat(total, touched);
        }
        totals[part] = total;
    }
}

__kernel void place_pairs(uint tiles, uint room, __global uint *restrict counts,
                          __global uint *restrict ranges, uint parts, __global uint *restrict table,
                          __global uint *restrict totals)
{
    if (get_global_id(0) > 0)
        return;
    ulong number = 0;
    for (uint part = 0; part < parts; part++) {
        const uint own = totals[part];
        totals[part] = (uint)number;
        number += own;
    }
    const bool failed = set_pairs(counts, number, room);
    uint place = 0;
    for (uint tile = 0; tile < tiles; tile++) {
        ranges[2 * tile] = place;
        for (uint part = 0; part < parts; part++) {
            const uint own = failed ? 0 : table[part * (ulong)tiles + tile];
            table[part * (ulong)tiles + tile] = place;
            place += own;
        }
        ranges[2 * tile + 1] = place;
    }
}

__kernel void emit_pairs(int tiles_x, int first_tile, int end_tile,
                         __global const uint *restrict counts, __global const real *restrict splats,
                         __global uint *restrict splat_counts, __global uint *restrict offsets,
                         __global const uint *restrict order, uint parts,
                         __global uint *restrict table, __global const uint *restrict totals,
                         __global uint *restrict sorted_splats,
                         __global uint *restrict emission_indices)
{
    const int tiles = end_tile - first_tile;
    FOR_EACH(part, parts) {
        __global uint *next = table + part * tiles;
        const ulong visible = counts[COUNT_VISIBLE];
        const uint begin = visible * part / parts, end = visible * (part + 1) / parts;
        uint index = totals[part];
        for (uint i = begin; i < end; i++) {
            const uint v = order[i];
            PREFETCH_ROW(splats, order[min(i + AHEAD, end - 1)], SPLAT_REALS);
            const Ellipse e = ellipse_of(splats + (ulong)v * SPLAT_REALS);
            int row, row_end, tile, tile_end;
            offsets[v] = index;
            band_rows(e, tiles_x, first_tile, end_tile, &row, &row_end);
            for (; row < row_end; row++) {
                band_tiles(e, row, tiles_x, first_tile, end_tile, &tile, &tile_end);
                for (; tile < tile_end; tile++, index++) {
                    const uint place = next[tile - first_tile]++;
                    sorted_splats[place] = v;
                    emission_indices[place] = index;
                }
            }
        }
    }
}
