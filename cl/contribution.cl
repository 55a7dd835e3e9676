// What each splat contributed to a frame, over the pixels where it was blended:
//
//   pixel count,  sum alpha T,  sum alpha T weight,  sum of the distance from its mean (pixels)
//
// weights: real[H, W], any image. Alpha and the skip rule are those of blend.cl; where pixels ended
// is read from its `last`: int[H, W]. splats: real[V, SPLAT_REALS]; ranges: uint[tiles, 2] into
// sorted_splats and slots: uint[P]. Sums of a pair go to its slot, real4[P], one writer each.
// This runs on a few views at a round of growth, so it is kept simple.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "footprint.h"

#if FORM_ITEM
#include "item/contribution.cl"
#else
#include "group/contribution.cl"
#endif

// Sums of each splat over its pairs, in slot order: totals[order[v]] from the rows of `sums` that
// begin at offsets[v]. carried: go on from what earlier bands left in `totals`.
__kernel void sum_contributions(uint count, uint carried,
                                __global const uint *restrict order,
                                __global const uint *restrict counts,
                                __global const uint *restrict offsets,
                                __global const real *restrict sums, __global real *restrict totals)
{
    FOR_EACH(v, count) {
        real4 total = carried ? vload4(order[v], totals) : (real4)(0);
        const ulong begin = offsets[v], end = begin + counts[v];
        for (ulong slot = begin; slot < end; slot++)
            total += vload4(slot, sums);
        vstore4(total, order[v], totals);
    }
}
