// Front-to-back alpha blending of each tile's splats, and the adjoint (Kerbl et al. 2023).
//
//   alpha = min(0.99, opacity exp(power)),  power = -1/2 d^T K d,  skipped below 1/255
//   C = sum_i alpha_i T_i c_i + T background,  T_i = prod_{j<i} (1 - alpha_j),
//   which ends before T < 1e-4
//
// splats: real[V, SPLAT_REALS]; ranges: uint[tiles, 2] into sorted_splats and emission_indices:
// uint[P]; image: real[3, H, W]; transmittance, depth: real[H, W]; last_contributor: int[H, W]: no
// later pair was blended. The adjoint writes the gradients of every pair (splat.h) to the row of
// its emission index, one writer each: no atomics; project.cl adds up those of a splat. The tiles
// are those from first_tile on: a frame whose pairs are too many comes in bands of tiles.
// WITH_EXPOSURE adds `exposed`: real[3, H, W], the image with the colour transform of a view
// (exposure.cl), row `view` of transforms: real[T, TRANSFORM_REALS]. WITH_VIGNETTING multiplies its
// colours before by the gain of the view's lens (vignetting.h), row lens_of[view] of lenses.
// WITH_DEPTH adds the channel sum_i alpha_i T_i z_i, and to the adjoint the gradients by it and by
// the final transmittance, so that a loss may read their ratio; otherwise these arrays are not
// touched. DEPTH_PERCENT makes it z_i of the splat that takes T to so many per cent, or of the last
// one that is blended before that; without an adjoint.
// WITH_LAYERS takes the background of each pixel from layers: uchar[3 or 7, H, W] (layers.h), and
// WITH_FRONT puts `exposed` behind their front layer, before gain and transform; `image` stays.
#include "real.h"
#include "each.h"
#include "splat.h"
#include "footprint.h"
#include "counts.h"

#ifndef WITH_DEPTH
#error "WITH_DEPTH must be 0 or 1"
#endif
#ifndef WITH_EXPOSURE
#define WITH_EXPOSURE 0
#endif
#ifndef WITH_VIGNETTING
#define WITH_VIGNETTING 0
#endif
#if WITH_VIGNETTING
#include "vignetting.h"
DEFINE_RADIUS(squared_radius, vreal)
#endif
#ifndef WITH_LAYERS
#define WITH_LAYERS 0
#endif
#ifndef WITH_FRONT
#define WITH_FRONT 0
#endif
#if WITH_LAYERS
#include "layers.h"
#endif
#ifndef DEPTH_PERCENT
#define DEPTH_PERCENT 0
#endif
#define DEPTH_AT (DEPTH_PERCENT / 100.0)
#define SUMS (PAIR_SUMS + WITH_DEPTH)

// A channel of `exposed`, of a pixel or a row of pixels.
#define EXPOSED(E, K, RED, GREEN, BLUE)                                                            \
    ((E)[4 * (K)] * (RED) + (E)[4 * (K) + 1] * (GREEN) + (E)[4 * (K) + 2] * (BLUE) +               \
     (E)[4 * (K) + 3])

// arguments that both forms have; those of one form alone follow them
#define BLEND_ARGUMENTS                                                                            \
    int width, int height, int tiles_x, int first_tile, __global const real *restrict background,  \
    __global const uint *restrict ranges, __global const uint *restrict sorted_splats,             \
    __global const real *restrict splats, __global real *restrict image,                           \
    __global real *restrict transmittance, __global int *restrict last_contributor,                \
    __global real *restrict depth, uint view, __global const real *restrict transforms,            \
    __global const real *restrict camera, __global const uint *restrict lens_of,                   \
    __global const real *restrict lenses, __global const uchar *restrict layers,                   \
    __global real *restrict exposed
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
