// What each splat contributed to a frame, over the pixels where it was blended:
//
//   pixel count,  sum alpha T,  sum alpha T weight,  sum of the distance from its mean (pixels)
//
// weights: real[H, W], any image. Alpha and the skip rule are those of blend.cl; where pixels ended
// is read from its `last_contributor`: int[H, W]. splats: real[V, SPLAT_REALS]; ranges: uint[tiles,
// 2] into sorted_splats and emission_indices: uint[P]. Sums of a pair go to the row of its emission
// index, real4[P], one writer each.
// This runs on a few views at a round of growth, so it is kept simple.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "footprint.h"
#include "counts.h"

#if FORM_ITEM
#include "item/contribution.cl"
#else
#include "group/contribution.cl"
#endif

// Sums of each splat over its pairs, in the order of emission: totals[v] from the rows of `sums`
// that begin at offsets[v]. carried: continue from what earlier bands left in `totals`.
__kernel void sum_contributions(uint carried, __global const uint *restrict counts,
                                __global const uint *restrict splat_counts,
                                __global const uint *restrict offsets,
                                __global const real *restrict sums, __global real *restrict totals)
{
    FOR_EACH(v, counts[COUNT_VISIBLE]) {
        real4 total = carried ? vload4(v, totals) : (real4)(0);
        const ulong begin = offsets[v], end = begin + splat_counts[v];
        for (ulong i = begin; i < end; i++)
            total += vload4(i, sums);
        vstore4(total, v, totals);
    }
}
