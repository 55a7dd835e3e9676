// Group form of match.cl (see there): a work-item owns a feature, a group SCAN_GROUP of a pair, all
// of which look at the same features of the other photo.
#define GROUP SCAN_GROUP
#include "group.h"

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void
nearest(uint blocks, uint pair_count, __global const int *restrict pairs,
        __global const real *restrict spread, __global int *restrict nearest,
        __global real *restrict products)
{
    __local real tile[DESCRIPTOR_SIZE * 16];
    const uint groups = (16 * blocks + GROUP - 1) / GROUP, row = get_group_id(0) / groups;
    const uint query = get_group_id(0) % groups * GROUP + get_local_id(0);
    const int2 pair = vload2(row, pairs);
    const ulong photo = (ulong)blocks * DESCRIPTOR_SIZE * 16; // elements
    const uint mine = min(query, 16 * blocks - 1); // all items meet at the barriers
    __global const real *own =
        spread + pair.x * photo + mine / 16 * DESCRIPTOR_SIZE * 16 + mine % 16;
    __global const real *other = spread + pair.y * photo;
    real best = -1, next = -1;
    int found = -1;
    for (uint block = 0; block < blocks; block++, other += DESCRIPTOR_SIZE * 16) {
        barrier(CLK_LOCAL_MEM_FENCE);
        FOR_GROUP(i, DESCRIPTOR_SIZE * 16) {
            tile[i] = other[i];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        real16 sums = 0;
        for (int k = 0; k < DESCRIPTOR_SIZE; k++)
            sums = MAD((real16)own[16 * k], vload16(k, tile), sums);
        real values[16];
        vstore16(sums, 0, values);
        for (int column = 0; column < 16; column++) {
            next = fmax(next, fmin(best, values[column]));
            found = values[column] > best ? (int)(16 * block) + column : found;
            best = fmax(best, values[column]);
        }
    }
    if (query < 16 * blocks) {
        const ulong at = (ulong)row * 16 * blocks + query;
        nearest[at] = found;
        vstore2((real2)(fmax(best, (real)0), fmax(next, (real)0)), at, products);
    }
}

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void
follow(uint features, uint pair_count, __global const int *restrict pairs,
       __global const int *restrict counts, __global const real *restrict geometry,
       __global const real *restrict points, __global const uchar *restrict descriptors,
       __global int *restrict nearest, __global real *restrict products)
{
    __local real tile[2 * GROUP];
    const uint groups = (features + GROUP - 1) / GROUP, row = get_group_id(0) / groups;
    const uint feature = get_group_id(0) % groups * GROUP + get_local_id(0);
    const int2 pair = vload2(row, pairs);
    const uint mine = min(feature, features - 1), count = counts[pair.y];
    __global const real *own = points + (ulong)pair.x * 2 * features;
    __global const real *xs = points + (ulong)pair.y * 2 * features, *ys = xs + features;
    __global const uchar *query = descriptors + ((ulong)pair.x * features + mine) * DESCRIPTOR_SIZE;
    const Allowed allowed =
        allowed_places(geometry + TWO_VIEW_REALS * row, own[mine], own[features + mine]);
    const bool counts_itself = (int)feature < counts[pair.x];
    real best = 0, next = 0;
    int found = -1;
    for (uint first = 0; first < count; first += GROUP) {
        barrier(CLK_LOCAL_MEM_FENCE);
        const uint loaded = min(first + (uint)get_local_id(0), features - 1);
        tile[get_local_id(0)] = xs[loaded];
        tile[GROUP + get_local_id(0)] = ys[loaded];
        barrier(CLK_LOCAL_MEM_FENCE);
        const uint held = min(count - first, (uint)GROUP);
        for (uint i = 0; i < held; i++) {
            real away_squared;
            AWAY_SQUARED(real, allowed, tile[i], tile[GROUP + i], away_squared)
            if (!(away_squared <= allowed.most * allowed.most && counts_itself))
                continue;
            __global const uchar *other =
                descriptors + ((ulong)pair.y * features + first + i) * DESCRIPTOR_SIZE;
            int4 sums = 0;
            for (int k = 0; k < DESCRIPTOR_SIZE / 4; k++)
                sums += convert_int4(vload4(k, query)) * convert_int4(vload4(k, other));
            const real product = sums.x + sums.y + sums.z + sums.w;
            next = fmax(next, fmin(best, product));
            found = product > best ? (int)(first + i) : found;
            best = fmax(best, product);
        }
    }
    if (feature < features) {
        const ulong at = (ulong)row * features + feature;
        nearest[at] = found;
        vstore2((real2)(best, next), at, products);
    }
}
