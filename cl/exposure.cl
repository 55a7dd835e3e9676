// The response of each training view (respond.h), learned beside the gaussians: photos drift in
// brightness and white balance (an affine colour map a photo, as Kerbl et al. 2024 use), and with
// WITH_VIGNETTING lenses make the corners of photos darker. blend.cl applies it; here are its
// adjoint and its step.
// Images and gradients: real[3, H, W], pixels = H W, of which a row has `width`; partials:
// real[blocks, RESPONSE_TERMS], sums over EXPOSURE_BLOCK pixels each (blocks of a fixed size: the
// same order of additions on any number of cores, and short sums).
#include "real.h"
#include "each.h"
#include "vector.h"
#include "counts.h"
#define WITH_RESPONSE 1
#include "respond.h"
#include "adam_row.h"

// The adjoint at one pixel or at 16 neighbours, from `pixel` on: the gradient by the image, and the
// shares in the sums.
#define DEFINE_PIXELS(SUFFIX, TYPE, LOAD, STORE)                                                   \
    DEFINE_RESPONSE(SUFFIX, TYPE)                                                                  \
    INLINE void pixels##SUFFIX(ulong plane, ulong pixel, const Response *response, TYPE u,         \
                               __global const real *image, __global const real *grad,              \
                               __global real *grad_image, TYPE *sums)                              \
    {                                                                                              \
        TYPE colour[3], by[3];                                                                     \
        for (int k = 0; k < 3; k++) {                                                              \
            colour[k] = LOAD(0, image + k * plane + pixel);                                        \
            by[k] = LOAD(0, grad + k * plane + pixel);                                             \
        }                                                                                          \
        respond_adjoint##SUFFIX(response, u, colour, by, sums);                                    \
        for (int k = 0; k < 3; k++)                                                                \
            STORE(by[k], 0, grad_image + k * plane + pixel);                                       \
    }
DEFINE_PIXELS(1, real, LOAD_ONE, STORE_ONE)
#define RADIUS_OF_ONE(P) RADIUS(1, response, (P) % width + (real)0.5, (P) / width + (real)0.5)

#define EXPOSURE_ADJOINT_ARGUMENTS                                                                 \
    uint pixels, uint width, uint blocks RESPONSE_ARGUMENTS, __global const real *restrict image,  \
        __global const real *restrict grad, __global real *restrict grad_image,                    \
        __global real *restrict partials
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
    __local real sums[PARTS][RESPONSE_TERMS];
    const uint part = get_local_id(0);
    real own[RESPONSE_TERMS];
    for (int k = 0; k < RESPONSE_TERMS; k++)
        own[k] = 0;
    for (uint block = part; block < blocks; block += PARTS)
        for (int k = 0; k < RESPONSE_TERMS; k++)
            own[k] += partials[block * RESPONSE_TERMS + k];
    for (int k = 0; k < RESPONSE_TERMS; k++)
        sums[part][k] = own[k];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (part > 0 || counts[COUNT_FAILED])
        return;
    transforms += view * TRANSFORM_REALS;
    const uint lens = lens_of[view];
    lenses += lens * VIGNETTING_REALS;
    real gradient[RESPONSE_TERMS];
    for (int k = 0; k < RESPONSE_TERMS; k++) {
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
