// The response of each training view, c' = M (g c) + t, learned beside the gaussians: photos drift
// in brightness and white balance (an affine colour map a photo, as Kerbl et al. 2024 use), and
// with WITH_VIGNETTING the gain g of a lens makes the corners of its photos darker (vignetting.h).
// blend.cl applies it; here are its adjoint and its step.
// transforms: real[V, TRANSFORM_REALS], a row [M | t] in row-major order; lens_of: uint[V], the row
// of each view in lenses; images and gradients: real[3, H, W], pixels = H W, of which a row has
// `width`; partials: real[blocks, EXPOSURE_SUMS], sums over EXPOSURE_BLOCK pixels each (blocks of a
// fixed size: the same order of additions on any number of cores, and short sums), by the
// transform, then by the lens's vignetting. WITH_FRONT, what is transformed is the image behind the
// front layer of layers: uchar[7, H, W] (layers.h).
#include "real.h"
#include "each.h"
#include "vector.h"
#include "counts.h"
#include "vignetting.h"
#include "adam_row.h"

#ifndef WITH_VIGNETTING
#error "WITH_VIGNETTING must be 0 or 1"
#endif
#ifndef WITH_FRONT
#define WITH_FRONT 0
#endif
#include "layers.h"
#define EXPOSURE_SUMS (TRANSFORM_REALS + WITH_VIGNETTING * VIGNETTING_TERMS)

// One pixel or 16 neighbours with squared radius u: the gradient by the untransformed colour, and
// the share in the sums. With z = M (g c) + t and G = grad by z, the gradient is g M^T G; the sums
// are of G (x) [g c, 1] and of (M^T G . c) [u, u^2, u^3]. `image`, `grad` and `grad_image` point at
// the pixel's red, `layers` at the pixel in their first plane.
#define DEFINE_PIXELS(NAME, TYPE, LOAD, STORE, BYTES)                                              \
    inline void NAME(ulong plane, const real *e, __global const real *lens, TYPE u,                \
                     __global const real *image, __global const real *grad,                        \
                     __global const uchar *layers, __global real *grad_image, TYPE *sums)          \
    {                                                                                              \
        TYPE light[3], by[3];                                                                      \
        const TYPE clear = WITH_FRONT ? BYTES(layers + FRONT_CLEAR_PLANE * plane) : 1;             \
        for (int k = 0; k < 3; k++) {                                                              \
            light[k] = LOAD(0, image + k * plane);                                                 \
            if (WITH_FRONT)                                                                        \
                light[k] = clear * light[k] + BYTES(layers + (FRONT_PLANE + k) * plane);           \
            by[k] = 0;                                                                             \
        }                                                                                          \
        const TYPE gain = WITH_VIGNETTING ? GAIN(lens, u) : 1;                                     \
        for (int k = 0; k < 3; k++) {                                                              \
            const TYPE grad_k = LOAD(0, grad + k * plane), gained = grad_k * gain;                 \
            for (int j = 0; j < 3; j++) {                                                          \
                by[j] += e[4 * k + j] * grad_k;                                                    \
                sums[4 * k + j] += gained * light[j];                                              \
            }                                                                                      \
            sums[4 * k + 3] += grad_k;                                                             \
        }                                                                                          \
        for (int k = 0; k < 3; k++) {                                                              \
            const TYPE result = gain * by[k];                                                      \
            STORE(WITH_FRONT ? clear * result : result, 0, grad_image + k * plane);                \
        }                                                                                          \
        if (WITH_VIGNETTING) {                                                                     \
            TYPE by_term = by[0] * light[0] + by[1] * light[1] + by[2] * light[2];                 \
            for (int k = 0; k < VIGNETTING_TERMS; k++) {                                           \
                by_term *= u;                                                                      \
                sums[TRANSFORM_REALS + k] += by_term;                                              \
            }                                                                                      \
        }                                                                                          \
    }
DEFINE_RADIUS(radius1, real)
DEFINE_PIXELS(pixels1, real, LOAD_ONE, STORE_ONE, ONE_BYTE)

// The squared radius of pixel p; not computed where it is not used.
inline real radius_of1(__global const real *camera, __global const real *lens, ulong p, uint width)
{
    return WITH_VIGNETTING ? radius1(camera, lens, p % width + (real)0.5, p / width + (real)0.5)
                           : 0;
}

#if FORM_ITEM
#include "item/exposure.cl"
#else
#include "group/exposure.cl"
#endif

// One step on the row of `view`, and on that of its lens: numbers that only count if all are
// finite; else both rows stay and `skipped` counts it. The loss has the penalties pull mean((E -
// I)^2) and pull mean((a, b, c)^2) of the vignetting beside the image's gradient, the sum of
// `partials`; the bias corrections go by the row's own steps. m, v: real[V, TRANSFORM_REALS];
// steps: uint[V]; lens_m, lens_v: the same for lenses; lens_steps: uint[L]. One group, in both
// forms: each of PARTS items adds up every PARTS-th row, and one item the rest. A frame that has
// failed changes nothing.
#define PARTS 16
__kernel __attribute__((reqd_work_group_size(PARTS, 1, 1)))
void exposure_step(uint view, real rate, real pull, __global const uint *restrict counts,
                   __global const real *restrict partials, uint blocks,
                   __global real *restrict transforms, __global real *restrict m,
                   __global real *restrict v, __global uint *restrict steps,
                   __global const uint *restrict lens_of, __global real *restrict lenses,
                   __global real *restrict lens_m, __global real *restrict lens_v,
                   __global uint *restrict lens_steps, __global uint *restrict skipped)
{
    __local real sums[PARTS][EXPOSURE_SUMS];
    const uint part = get_local_id(0);
    real own[EXPOSURE_SUMS];
    for (int k = 0; k < EXPOSURE_SUMS; k++)
        own[k] = 0;
    for (uint block = part; block < blocks; block += PARTS)
        for (int k = 0; k < EXPOSURE_SUMS; k++)
            own[k] += partials[block * EXPOSURE_SUMS + k];
    for (int k = 0; k < EXPOSURE_SUMS; k++)
        sums[part][k] = own[k];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (part > 0 || counts[COUNT_FAILED])
        return;
    transforms += view * TRANSFORM_REALS;
    const uint lens = lens_of[view];
    lenses += lens * VIGNETTING_REALS;
    real gradient[EXPOSURE_SUMS];
    for (int k = 0; k < EXPOSURE_SUMS; k++) {
        if (k < TRANSFORM_REALS)
            gradient[k] = pull * 2 / TRANSFORM_REALS * (transforms[k] - (k % 5 == 0 ? 1 : 0));
        else
            gradient[k] = pull * 2 / VIGNETTING_TERMS * lenses[k - TRANSFORM_REALS];
        for (int p = 0; p < PARTS; p++)
            gradient[k] += sums[p][k];
        if (!isfinite(gradient[k] * gradient[k])) { // an infinite v would never heal
            ++*skipped;
            return;
        }
    }
    adam_row(gradient, TRANSFORM_REALS, ++steps[view], rate, transforms, m + view * TRANSFORM_REALS,
             v + view * TRANSFORM_REALS);
    if (WITH_VIGNETTING)
        adam_row(gradient + TRANSFORM_REALS, VIGNETTING_TERMS, ++lens_steps[lens], rate, lenses,
                 lens_m + lens * VIGNETTING_TERMS, lens_v + lens * VIGNETTING_TERMS);
}
