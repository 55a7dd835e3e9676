// Front-to-back alpha blending of each tile's splats, and the adjoint (Kerbl et al. 2023).
//
//   alpha = min(0.99, opacity exp(power)),  power = -1/2 d^T K d,  skipped below 1/255
//   C = sum_i alpha_i T_i c_i + T background,  T_i = prod_{j<i} (1 - alpha_j),  ends before T < 1e-4
//
// splats: real[V, SPLAT_REALS]; ranges: uint[tiles, 2] into sorted_splats and emission_indices:
// uint[P]; image: real[3, H, W]; transmittance, depth: real[H, W]; last_contributor: int[H, W]: no
// later pair was blended. The adjoint writes the gradients of every pair (splat.h) to the row of its
// emission index, one writer each: no atomics.
// The tiles are those from first_tile on: a frame whose pairs are too many comes in bands of tiles.
// WITH_DEPTH adds the channel sum_i alpha_i T_i z_i, and to the adjoint the gradients by it and by the
// final transmittance, so that a loss may read their ratio; otherwise these arrays are not touched.
//
// sum_pairs adds up each splat's gradients over its pairs, in the order of emission: totals[v, :] from the
// rows of `pair_grads` that begin at offsets[v]. carried: continue from what earlier bands
// left in `totals`; a splat's pairs are emitted in the order of tiles, which is that of bands too: the
// additions are those of a frame in one piece.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "footprint.h"
#include "counts.h"

#ifndef WITH_DEPTH
#error "WITH_DEPTH must be 0 or 1"
#endif
#define SUMS (PAIR_SUMS + WITH_DEPTH)

// arguments that both forms have; those of one form alone follow them
#define BLEND_ARGUMENTS                                                                            \
    int width, int height, int tiles_x, int first_tile, __global const real *restrict background,  \
    __global const uint *restrict ranges, __global const uint *restrict sorted_splats,             \
    __global const real *restrict splats, __global real *restrict image,                           \
    __global real *restrict transmittance, __global int *restrict last_contributor,                \
    __global real *restrict depth
#define BLEND_ADJOINT_ARGUMENTS                                                                    \
    int width, int height, int tiles_x, int first_tile, __global const uint *restrict ranges,      \
    __global const uint *restrict sorted_splats, __global const uint *restrict emission_indices,   \
    __global const real *restrict splats, __global const real *restrict transmittance,             \
    __global const int *restrict last_contributor, __global const real *restrict grad_image,       \
    __global const real *restrict grad_depth, __global const real *restrict grad_transmittance,    \
    __global real *restrict pair_grads

#if FORM_ITEM
#include "item/blend.cl"
#else
#include "group/blend.cl"
#endif
