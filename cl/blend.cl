// Front-to-back alpha blending of each tile's splats, and the adjoint (Kerbl et al. 2023).
//
//   alpha = min(0.99, opacity exp(power)),  power = -1/2 d^T K d,  skipped below 1/255
//   C = sum_i alpha_i T_i c_i + T background,  T_i = prod_{j<i} (1 - alpha_j),
//   which ends before T < 1e-4
//
// splats: real[V, SPLAT_REALS]; ranges: uint[tiles, 2] into sorted_splats and emission_indices:
// uint[P]; image: real[CHANNELS, H, W] (channels.h); background: real[CHANNELS]; transmittance,
// depth: real[H, W]; last_contributor: int[H, W]: no later pair was blended. The adjoint writes the
// gradients of every pair (splat.h) to the row of its emission index, one writer each: no atomics;
// project.cl adds up those of a splat. The tiles are those from first_tile on: a frame whose pairs
// are too many comes in bands of tiles.
//
// A build has the arrays of its choices alone. WITH_RESPONSE adds `exposed`: real[3, H, W], the
// response of a camera to the image (respond.h).
// WITH_DEPTH adds the channel sum_i alpha_i T_i z_i, and to the adjoint the gradients by it and by
// the final transmittance, so that a loss may read their ratio. DEPTH_PERCENT makes it z_i of the
// splat that takes T to so many per cent, or of the last one that is blended before that; without
// an adjoint.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "footprint.h"
#include "counts.h"
#include "channels.h"
#include "respond.h"

#if WITH_DEPTH
#define IF_DEPTH(CODE) CODE
#define DEPTH_ARGUMENT(NAME) , __global real *restrict NAME
#define DEPTH_INPUT(NAME) , __global const real *restrict NAME
#else
#define IF_DEPTH(CODE)
#define DEPTH_ARGUMENT(NAME)
#define DEPTH_INPUT(NAME)
#endif
#define DEPTH_AT (DEPTH_PERCENT / 100.0)
#define TILES_X ((width + TILE - 1) / TILE)
IF_RESPONSE(DEFINE_RESPONSE(, vreal))

// arguments that both forms have; those of one form alone follow them
#define BLEND_ARGUMENTS                                                                            \
    int width, int height, int first_tile, __global const real *restrict background,               \
        __global const uint *restrict ranges, __global const uint *restrict sorted_splats,         \
        __global const real *restrict splats FEATURES_ARGUMENT, __global real *restrict image,     \
        __global real *restrict transmittance,                                                     \
        __global int *restrict last_contributor DEPTH_ARGUMENT(depth) RESPONSE_ARGUMENTS           \
            EXPOSED_ARGUMENT
#define BLEND_ADJOINT_ARGUMENTS                                                                    \
    int width, int height, int first_tile, __global const uint *restrict ranges,                   \
        __global const uint *restrict sorted_splats,                                               \
        __global const uint *restrict emission_indices,                                            \
        __global const real *restrict splats FEATURES_ARGUMENT,                                    \
        __global const real *restrict transmittance,                                               \
        __global const int *restrict last_contributor, __global const real *restrict grad_image    \
            DEPTH_INPUT(grad_depth) DEPTH_INPUT(grad_transmittance),                               \
        __global real *restrict pair_grads

#if FORM_ITEM
#include "item/blend.cl"
#else
#include "group/blend.cl"
#endif
