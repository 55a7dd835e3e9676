// Front-to-back alpha blending of each tile's splats, and the adjoint (Kerbl et al. 2023).
//
//   alpha = min(0.99, opacity exp(power)),  power = -1/2 d^T K d,  skipped below 1/255
//   C = sum_i alpha_i T_i c_i + T background,  T_i = prod_{j<i} (1 - alpha_j),  ends before T < 1e-4
//
// splats: real[V, SPLAT_REALS]; ranges: uint[tiles, 2] into sorted_splats and slots: uint[P];
// image: real[3, H, W]; transmittance, depth: real[H, W]; last: int[H, W]: no later pair was blended.
// The adjoint writes every pair's sums (splat.h) at the pair's slot, one writer each: no atomics.
// The tiles are those from first_tile on: a frame whose pairs are too many comes in bands of tiles.
// WITH_DEPTH adds the channel sum_i alpha_i T_i z_i, and to the adjoint the gradients by it and by the
// final transmittance, so that a loss may read their ratio; otherwise these arrays are not touched.
//
// Item form (CPUs): a work-item owns a tile; a row of 16 pixels is one vector; the tile's state
// lives in private memory; rows a splat's ellipse does not reach, or that are opaque, are skipped.
// Group form (GPUs): forward, a group owns a tile and stages splats in local memory; it notes T and
// C of every pixel once a bucket of BUCKET pairs. Adjoint, a group of BUCKET lanes owns a bucket:
// lane l holds splat l while the tile's pixels stream through the lanes, (T, C . grad) passing
// from lane to lane, so that each lane sums its own splat without any reduction.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "footprint.h"

#ifndef WITH_DEPTH
#error "WITH_DEPTH must be 0 or 1"
#endif
#define SUMS (9 + WITH_DEPTH)

#if FORM_ITEM
#include "blend_item.h"
#else
#include "blend_group.h"
#endif

// Sums of each splat over its pairs, in slot order: totals[order[v], :] from the rows of `sums` that
// begin at offsets[v]. carried: go on from what earlier bands left in `totals`; slots are in the
// order of tiles, and so are bands: the additions are those of a frame in one piece.
// Item form: an element is a splat; eight columns are one vector, or Intel's compiler would sum every
// column over several slots at a time, in another order. Group form: it is a splat's column.
#if FORM_ITEM
__kernel void sum_pairs(uint count, uint carried, __global const uint *restrict order,
                        __global const uint *restrict counts,
                        __global const uint *restrict offsets, __global const real *restrict sums,
                        __global real *restrict totals)
{
    FOR_EACH(v, count) {
        __global real *own = totals + (ulong)order[v] * SUMS;
        real8 total = carried ? vload8(0, own) : (real8)(0);
        real rest[SUMS - 8];
        for (int j = 0; j < SUMS - 8; j++)
            rest[j] = carried ? own[8 + j] : 0;
        const ulong begin = (ulong)offsets[v] * SUMS, end = begin + (ulong)counts[v] * SUMS;
        for (ulong i = begin; i < end; i += SUMS) {
            total += vload8(0, sums + i);
            for (int j = 0; j < SUMS - 8; j++)
                rest[j] += sums[i + 8 + j];
        }
        vstore8(total, 0, own);
        for (int j = 0; j < SUMS - 8; j++)
            own[8 + j] = rest[j];
    }
}
#else
__kernel void sum_pairs(uint count, uint carried, __global const uint *restrict order,
                        __global const uint *restrict counts,
                        __global const uint *restrict offsets, __global const real *restrict sums,
                        __global real *restrict totals)
{
    FOR_EACH(i, (ulong)count * SUMS) {
        const ulong v = i / SUMS, begin = offsets[v], end = begin + counts[v];
        __global real *own = totals + (ulong)order[v] * SUMS + i % SUMS;
        real total = carried ? *own : 0;
        for (ulong slot = begin; slot < end; slot++)
            total += sums[slot * SUMS + i % SUMS];
        *own = total;
    }
}
#endif
