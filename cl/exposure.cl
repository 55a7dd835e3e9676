// A colour transform a training view, c' = M c + t, learned beside the gaussians: photos drift in
// brightness and white balance (an affine colour map a photo, as Kerbl et al. 2024 use).
// transforms: real[V, TRANSFORM_REALS], a row [M | t] in row-major order; images and gradients:
// real[3, H, W], pixels = H W; partials: real[blocks, TRANSFORM_REALS], sums over EXPOSURE_BLOCK
// pixels each (blocks of a fixed size: the same order of additions on any number of cores, and short
// sums).
#include "real.h"
#include "each.h"
#include "vector.h"
#include "counts.h"

__kernel void exposure_apply(uint pixels, uint view, __global const real *restrict transforms,
                             __global const real *restrict image, __global real *restrict result)
{
    real e[TRANSFORM_REALS];
    for (int k = 0; k < TRANSFORM_REALS; k++)
        e[k] = transforms[view * TRANSFORM_REALS + k];
    FOR_EACH(p, pixels) {
        const real r = image[p], g = image[pixels + p], b = image[2ul * pixels + p];
        result[p] = e[0] * r + e[1] * g + e[2] * b + e[3];
        result[pixels + p] = e[4] * r + e[5] * g + e[6] * b + e[7];
        result[2ul * pixels + p] = e[8] * r + e[9] * g + e[10] * b + e[11];
    }
}

// One pixel or 16 neighbours: the gradient by the untransformed colour, M^T grad, and the share in
// the sums of grad (x) [c, 1]. `image`, `grad` and `grad_image` point at the pixel's red.
#define DEFINE_PIXELS(NAME, TYPE, LOAD, STORE)                                                     \
    inline void NAME(ulong plane, const real *e, __global const real *image,                       \
                     __global const real *grad, __global real *grad_image, TYPE *sums)             \
    {                                                                                              \
        const TYPE r = LOAD(0, image), g = LOAD(0, image + plane), b = LOAD(0, image + 2 * plane); \
        TYPE by_r = 0, by_g = 0, by_b = 0;                                                         \
        for (int k = 0; k < 3; k++) {                                                              \
            const TYPE by = LOAD(0, grad + k * plane);                                             \
            by_r += e[4 * k] * by;                                                                 \
            by_g += e[4 * k + 1] * by;                                                             \
            by_b += e[4 * k + 2] * by;                                                             \
            sums[4 * k] += by * r;                                                                 \
            sums[4 * k + 1] += by * g;                                                             \
            sums[4 * k + 2] += by * b;                                                             \
            sums[4 * k + 3] += by;                                                                 \
        }                                                                                          \
        STORE(by_r, 0, grad_image);                                                                \
        STORE(by_g, 0, grad_image + plane);                                                        \
        STORE(by_b, 0, grad_image + 2 * plane);                                                    \
    }
DEFINE_PIXELS(pixels1, real, LOAD_ONE, STORE_ONE)

#if FORM_ITEM
#include "item/exposure.cl"
#else
#include "group/exposure.cl"
#endif

// One step of Adam (Kingma & Ba 2015) on the row of `view`: twelve numbers that only count if all are
// finite; else the row stays and `skipped` counts it. The loss has the penalty pull mean((E - I)^2) beside
// the image's gradient, the sum of `partials`; the bias corrections go by the row's own steps, from
// log(beta): in single precision 1 - 0.999^t loses digits. m, v: real[V, TRANSFORM_REALS]; steps:
// uint[V]. One group, in both forms: each of PARTS items adds up every PARTS-th row, and one item the rest. A frame that has failed changes nothing.
#define PARTS 16
__kernel __attribute__((reqd_work_group_size(PARTS, 1, 1)))
void exposure_step(uint view, real rate, real pull, __global const uint *restrict counts,
                   __global const real *restrict partials, uint blocks,
                   __global real *restrict transforms, __global real *restrict m,
                   __global real *restrict v, __global uint *restrict steps,
                   __global uint *restrict skipped)
{
    __local real sums[PARTS][TRANSFORM_REALS];
    const uint part = get_local_id(0);
    real own[TRANSFORM_REALS];
    for (int k = 0; k < TRANSFORM_REALS; k++)
        own[k] = 0;
    for (uint block = part; block < blocks; block += PARTS)
        for (int k = 0; k < TRANSFORM_REALS; k++)
            own[k] += partials[block * TRANSFORM_REALS + k];
    for (int k = 0; k < TRANSFORM_REALS; k++)
        sums[part][k] = own[k];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (part > 0 || counts[COUNT_FAILED])
        return;
    transforms += view * TRANSFORM_REALS;
    m += view * TRANSFORM_REALS;
    v += view * TRANSFORM_REALS;
    real gradient[TRANSFORM_REALS];
    for (int k = 0; k < TRANSFORM_REALS; k++) {
        const real from_identity = transforms[k] - (k % 5 == 0 ? 1 : 0);
        gradient[k] = pull * 2 / TRANSFORM_REALS * from_identity;
        for (int p = 0; p < PARTS; p++)
            gradient[k] += sums[p][k];
        if (!isfinite(gradient[k] * gradient[k])) { // an infinite v would never heal
            ++*skipped;
            return;
        }
    }
    const uint step = ++steps[view];
    const real correction1 = -expm1(step * (real)LOG_BETA1);
    const real correction2 = -expm1(step * (real)LOG_BETA2);
    for (int k = 0; k < TRANSFORM_REALS; k++) {
        const real g = gradient[k];
        m[k] += (real)ONE_MINUS_BETA1 * (g - m[k]);
        v[k] += (real)ONE_MINUS_BETA2 * (g * g - v[k]);
        transforms[k] -= rate * (m[k] / correction1) / (sqrt(v[k] / correction2) + (real)ADAM_EPSILON);
    }
}
