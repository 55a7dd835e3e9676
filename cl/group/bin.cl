// Group form of bin.cl (see there): a group counts and emits the splats of a chunk of GROUP rows,
// and sorts the pairs of a tile.
//
// steps: uint[tiles + 1], zero before: how many splats begin to touch tiles at each tile, less
// those that end there; place_pairs leaves zeros there, emit_pairs counts in them what each tile
// has, and sort_tiles leaves zeros again.
// totals, first_indices: uint[chunks], the pairs of each chunk, and the emission index of its
// first. bucket_offsets: uint[tiles], the first bucket of BUCKET pairs of each tile. keys: ulong[2,
// P], a pair's depth and emission index, in the first half; the second is for tiles with more pairs
// than a group sorts at once.
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_GROUP_SCAN(group_scan, uint)
DEFINE_GROUP_SCAN(group_scan_long, ulong)
#ifndef GIANT // tiles of a splat above which it is a giant
#define GIANT 1024
#endif
#define SORTED_AT_ONCE (GROUP * PER_ITEM)
#define FEW (GROUP / 2) // keys that are sorted by counting smaller ones

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void count_pairs(int tiles_x, int first_tile, int end_tile, __global const uint *restrict counts,
                 __global const real *restrict splats, __global uint *restrict splat_counts,
                 __global uint *restrict steps, __global uint *restrict totals)
{
    __local uint scratch[GROUP];
    const uint v = get_global_id(0);
    uint touched = 0, total;
    if (v < counts[COUNT_VISIBLE]) {
        const Ellipse e = ellipse_of(splats + (ulong)v * SPLAT_REALS);
        int row, row_end, tile, tile_end;
        band_rows(e, tiles_x, first_tile, end_tile, &row, &row_end);
        for (; row < row_end; row++) {
            band_tiles(e, row, tiles_x, first_tile, end_tile, &tile, &tile_end);
            if (tile < tile_end) {
                touched += tile_end - tile;
                atomic_inc(&steps[tile - first_tile]);
                atomic_dec(&steps[tile_end - first_tile]);
            }
        }
        splat_counts[v] = touched;
    }
    group_scan(touched, scratch, &total);
    if (get_local_id(0) == 0)
        totals[get_group_id(0)] = total;
}

// Two groups: the first finds where each tile begins, the second where each chunk does.
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void place_pairs(uint tiles, uint room, __global uint *restrict counts,
                 __global uint *restrict ranges, uint chunks, __global uint *restrict steps,
                 __global const uint *restrict totals, __global uint *restrict first_indices,
                 __global uint *restrict bucket_offsets)
{
    __local uint scratch[GROUP];
    __local ulong scratch_long[GROUP];
    __local int failed;
    const uint lane = get_local_id(0);
    uint own[PER_ITEM], total;
    if (get_group_id(0) == 1) {
        uint before = 0;
        for (uint base = 0; base < chunks; base += GROUP * PER_ITEM) {
            const uint begin = base + lane * PER_ITEM;
            uint sum = 0;
            for (uint j = 0; j < PER_ITEM; j++) {
                own[j] = begin + j < chunks ? totals[begin + j] : 0;
                sum += own[j];
            }
            uint index = before + group_scan(sum, scratch, &total);
            before += total;
            for (uint j = 0; j < PER_ITEM; j++) {
                if (begin + j < chunks)
                    first_indices[begin + j] = index;
                index += own[j];
            }
        }
        return;
    }
    ulong number = 0, all;
    FOR_GROUP(i, chunks)
        number += totals[i];
    group_scan_long(number, scratch_long, &all);
    if (lane == 0)
        failed = set_pairs(counts, all, room);
    barrier(CLK_LOCAL_MEM_FENCE);
    const bool empty = failed != 0;
    uint running = 0; // splats that touch the tile before
    ulong before = 0; // pairs, and above them buckets, of all tiles before
    for (uint base = 0; base < tiles; base += GROUP * PER_ITEM) {
        const uint begin = base + lane * PER_ITEM;
        uint sum = 0;
        for (uint j = 0; j < PER_ITEM; j++) {
            own[j] = begin + j < tiles ? steps[begin + j] : 0;
            sum += own[j];
        }
        uint touching = running + group_scan(sum, scratch, &total);
        running += total;
        ulong places = 0, all_places;
        for (uint j = 0; j < PER_ITEM; j++) {
            touching += own[j];
            own[j] = begin + j < tiles && !empty ? touching : 0;
            places += own[j] | (ulong)((own[j] + BUCKET - 1) / BUCKET) << 32;
        }
        ulong place = before + group_scan_long(places, scratch_long, &all_places);
        before += all_places;
        for (uint j = 0; j < PER_ITEM; j++) {
            if (begin + j < tiles) {
                ranges[2 * (begin + j)] = (uint)place;
                ranges[2 * (begin + j) + 1] = (uint)place + own[j];
                bucket_offsets[begin + j] = (uint)(place >> 32);
                steps[begin + j] = 0;
            }
            place += own[j] | (ulong)((own[j] + BUCKET - 1) / BUCKET) << 32;
        }
    }
    if (lane == 0) {
        steps[tiles] = 0;
        counts[COUNT_BUCKETS] = (uint)(before >> 32);
    }
}

inline void emit_pair(int tile, uint v, uint index, real depth, __global const uint *ranges,
                      __global uint *steps, __global uint *pair_splats, __global ulong *keys)
{
    const uint place = ranges[2 * tile] + atomic_inc(&steps[tile]);
    pair_splats[index] = v;
    keys[place] = (ulong)as_uint((float)depth) << 32 | index; // positive floats order as their bits
}

// Where the pair number `own` of a splat lies, counted from the splat's first: its tile.
inline int tile_of_pair(Ellipse e, uint own, int tiles_x, int first_tile, int end_tile)
{
    int row, row_end, tile = 0, tile_end;
    band_rows(e, tiles_x, first_tile, end_tile, &row, &row_end);
    for (; row < row_end; row++) {
        band_tiles(e, row, tiles_x, first_tile, end_tile, &tile, &tile_end);
        const uint width = max(0, tile_end - tile);
        if (own < width)
            break;
        own -= width;
    }
    return tile + (int)own;
}

// The pairs of a chunk are dealt to the items of its group one by one, so that none waits for
// another whose splat has many. A giant's are dealt row by row of tiles, as finding them one by one
// would take long.
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void emit_pairs(int tiles_x, int first_tile, int end_tile, __global const uint *restrict counts,
                __global const real *restrict splats, __global const uint *restrict splat_counts,
                __global uint *restrict offsets, __global const uint *restrict ranges,
                __global uint *restrict steps, __global const uint *restrict first_indices,
                __global uint *restrict pair_splats, __global ulong *restrict keys)
{
    __local uint scratch[GROUP], begins[GROUP], giants[GROUP];
    __local uint giant_count;
    const uint lane = get_local_id(0), first = get_group_id(0) * GROUP, v = first + lane;
    const uint visible = counts[COUNT_VISIBLE], base = first_indices[get_group_id(0)];
    const uint touched = v < visible ? splat_counts[v] : 0;
    const bool is_giant = touched > GIANT;
    uint total, small_total;
    if (lane == 0)
        giant_count = 0;
    const uint index = base + group_scan(touched, scratch, &total);
    begins[lane] = group_scan(is_giant ? 0 : touched, scratch, &small_total);
    if (v < visible)
        offsets[v] = index;
    if (is_giant)
        giants[atomic_inc(&giant_count)] = lane;
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    for (uint pair = lane; pair < small_total; pair += GROUP) {
        uint own = 0; // the last splat that begins at or before the pair and has one
        for (uint step = GROUP / 2; step > 0; step >>= 1)
            if (begins[own + step] <= pair)
                own += step;
        __global const real *splat = splats + (ulong)(first + own) * SPLAT_REALS;
        const uint number = pair - begins[own];
        const int tile = tile_of_pair(ellipse_of(splat), number, tiles_x, first_tile, end_tile);
        emit_pair(tile - first_tile, first + own, offsets[first + own] + number, splat[SPLAT_DEPTH],
                  ranges, steps, pair_splats, keys);
    }
    const uint all = giant_count;
    for (uint g = 0; g < all; g++) {
        const uint giant = first + giants[g];
        __global const real *splat = splats + (ulong)giant * SPLAT_REALS;
        const Ellipse e = ellipse_of(splat);
        const real depth = splat[SPLAT_DEPTH];
        uint place = offsets[giant];
        int row, row_end, tile, tile_end;
        band_rows(e, tiles_x, first_tile, end_tile, &row, &row_end);
        for (; row < row_end; row++) {
            band_tiles(e, row, tiles_x, first_tile, end_tile, &tile, &tile_end);
            for (int own = tile + (int)lane; own < tile_end; own += GROUP)
                emit_pair(own - first_tile, giant, place + own - tile, depth, ranges, steps,
                          pair_splats, keys);
            place += max(0, tile_end - tile);
        }
    }
}

// Bitonic sort (Batcher 1968) of `size` keys in local memory, a power of two.
inline void sort_local(__local ulong *keys, uint size)
{
    for (uint run = 2; run <= size; run <<= 1) {
        for (uint step = run >> 1; step > 0; step >>= 1) {
            FOR_GROUP(i, size / 2) {
                const uint low = 2 * i - (i & (step - 1)), high = low + step;
                const ulong a = keys[low], b = keys[high];
                if ((a > b) == ((low & run) == 0)) {
                    keys[low] = b;
                    keys[high] = a;
                }
            }
            barrier(CLK_LOCAL_MEM_FENCE);
        }
    }
}

// How many of `count` ascending keys are smaller.
inline uint keys_below(__global const ulong *keys, uint count, ulong key)
{
    uint begin = 0;
    while (count > 0) {
        const uint middle = count / 2;
        if (keys[begin + middle] < key) {
            begin += middle + 1;
            count -= middle + 1;
        } else
            count = middle;
    }
    return begin;
}

// The place of each of few keys is the number of smaller ones: one barrier instead of dozens.
inline void sort_few(__local const ulong *unsorted, __local ulong *sorted, uint count)
{
    FOR_GROUP(i, count) {
        const ulong key = unsorted[i];
        uint place = 0;
        for (uint j = 0; j < count; j++)
            place += unsorted[j] < key;
        sorted[place] = key;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// A group a tile: runs of SORTED_AT_ONCE keys in local memory, which are then merged. Keys are
// unique: a key's place is its place in its own run and the number of smaller ones in the other.
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sort_tiles(uint room, __global const uint *restrict counts,
                __global const uint *restrict ranges, __global uint *restrict steps,
                __global const uint *restrict pair_splats,
                __global const uint *restrict bucket_offsets, __global ulong *keys,
                __global uint *restrict sorted_splats, __global uint *restrict emission_indices,
                __global uint *restrict bucket_tiles)
{
    __local ulong chunk[SORTED_AT_ONCE];
    const uint tile = get_group_id(0), begin = ranges[2 * tile];
    const uint count = ranges[2 * tile + 1] - begin, buckets = (count + BUCKET - 1) / BUCKET;
    if (get_local_id(0) == 0)
        steps[tile] = 0;
    FOR_GROUP(i, buckets)
        bucket_tiles[bucket_offsets[tile] + i] = tile;
    // those past the last bucket: Intel's compiler reads what their tiles point to before it leaves
    const uint tiles = get_num_groups(0), most = room / BUCKET + tiles;
    for (uint base = counts[COUNT_BUCKETS] + tile * GROUP; base < most; base += tiles * GROUP) {
        if (base + get_local_id(0) < most)
            bucket_tiles[base + get_local_id(0)] = 0;
    }
    __global ulong *from = keys + begin, *to = keys + room + begin;
    for (uint first = 0; first < count; first += SORTED_AT_ONCE) {
        const uint own = min(count - first, (uint)SORTED_AT_ONCE);
        uint size = 1;
        while (size < own)
            size <<= 1;
        FOR_GROUP(i, size)
            chunk[i] = i < own ? from[first + i] : ULONG_MAX;
        barrier(CLK_LOCAL_MEM_FENCE);
        const bool few = own <= FEW;
        if (few)
            sort_few(chunk, chunk + FEW, own);
        else
            sort_local(chunk, size);
        FOR_GROUP(i, own)
            from[first + i] = chunk[few ? FEW + i : i];
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    barrier(CLK_GLOBAL_MEM_FENCE);
    for (uint run = SORTED_AT_ONCE; run < count; run <<= 1) {
        FOR_GROUP(i, count) {
            const ulong key = from[i];
            const uint own = i / (2 * run) * (2 * run), left = i - own < run;
            const uint other = left ? min(own + run, count) : own;
            const uint length = left ? min(own + 2 * run, count) - other : run;
            to[i - (left ? 0 : run) + keys_below(from + other, length, key)] = key;
        }
        barrier(CLK_GLOBAL_MEM_FENCE);
        __global ulong *const swapped = from;
        from = to;
        to = swapped;
    }
    FOR_GROUP(i, count) {
        const uint index = (uint)from[i];
        sorted_splats[begin + i] = pair_splats[index];
        emission_indices[begin + i] = index;
    }
}
