// The response of each training view, c' = M (g c) + t, learned beside the gaussians: photos drift
// in brightness and white balance (an affine colour map a photo, as Kerbl et al. 2024 use), and
// with WITH_VIGNETTING the gain g of a lens makes the corners of its photos darker (vignetting.h).
// WITH_TONE, the tone curve f of the lens (tone.h) is around both, c' = f(M (g f^-1(c)) + t): the
// image has the colours of a photo, and where M = I, t = 0 and g = 1, f changes nothing.
// blend.cl applies it; here are its adjoint and its step.
// transforms: real[V, TRANSFORM_REALS], a row [M | t] in row-major order; lens_of: uint[V], the row
// of each view in lenses; images and gradients: real[3, H, W], pixels = H W, of which a row has
// `width`; partials: real[blocks, EXPOSURE_SUMS], sums over EXPOSURE_BLOCK pixels each (blocks of a
// fixed size: the same order of additions on any number of cores, and short sums), by the
// transform, then by the lens's vignetting, then by its tone curve. WITH_FRONT, what is transformed
// is the image behind the front layer of layers: uchar[7, H, W] (layers.h).
#include "real.h"
#include "each.h"
#include "vector.h"
#include "counts.h"
#include "vignetting.h"
#include "tone.h"
#include "adam_row.h"

#ifndef WITH_VIGNETTING
#error "WITH_VIGNETTING must be 0 or 1"
#endif
#ifndef WITH_TONE
#error "WITH_TONE must be 0 or 1"
#endif
#ifndef WITH_FRONT
#define WITH_FRONT 0
#endif
#include "layers.h"
#define TONE_SUM (TRANSFORM_REALS + WITH_VIGNETTING * VIGNETTING_TERMS) // the first of the curve's
#define EXPOSURE_SUMS (TONE_SUM + WITH_TONE * TONE_TERMS)

// One channel of a pixel or of 16 neighbours: y to the light f^-1(y) that makes it, its derivatives
// by y and by (a, b); and the derivatives of f(x).
#define DEFINE_CURVE(SUFFIX, TYPE)                                                                 \
    DEFINE_TONE(SUFFIX, TYPE)                                                                      \
    inline TYPE to_light##SUFFIX(TYPE y, const real *curve, TYPE *slope, TYPE *by_curve)           \
    {                                                                                              \
        const TYPE middle = bend##SUFFIX(y, 1 / curve[0]), t = 2 * middle - 1;                     \
        const TYPE bent = bend##SUFFIX(t, 1 / curve[1]);                                           \
        const TYPE rate = bend_slope##SUFFIX(t, 1 / curve[1]);                                     \
        *slope = rate * bend_slope##SUFFIX(y, 1 / curve[0]);                                       \
        by_curve[0] = -rate * bend_speed##SUFFIX(middle);                                          \
        by_curve[1] = (real)-0.5 * bend_speed##SUFFIX(bent);                                       \
        return (real)0.5 * (1 + bent);                                                             \
    }                                                                                              \
    inline void from_light##SUFFIX(TYPE x, const real *curve, TYPE *slope, TYPE *by_curve)         \
    {                                                                                              \
        const TYPE t = 2 * x - 1, bent = bend##SUFFIX(t, curve[1]);                                \
        const TYPE middle = (real)0.5 * (1 + bent), rate = bend_slope##SUFFIX(middle, curve[0]);   \
        *slope = rate * bend_slope##SUFFIX(t, curve[1]);                                           \
        by_curve[0] = bend_speed##SUFFIX(bend##SUFFIX(middle, curve[0]));                          \
        by_curve[1] = (real)0.5 * rate * bend_speed##SUFFIX(bent);                                 \
    }

// One pixel or 16 neighbours with squared radius u: the gradient by the untransformed colour, and
// the share in the sums. With l = f^-1(c), z = M (g l) + t and G = f'(z) grad, the gradient is
// (f^-1)'(c) g M^T G; the sums are of G (x) [g l, 1], of (M^T G . l) [u, u^2, u^3], and for a
// parameter p of f of grad . df/dp(z) + g M^T G . d(f^-1)/dp(c). `image`, `grad` and `grad_image`
// point at the pixel's red, `layers` at the pixel in their first plane.
#define DEFINE_PIXELS(NAME, SUFFIX, TYPE, LOAD, STORE, BYTES)                                      \
    inline void NAME(ulong plane, const real *e, __global const real *lens, const real *curve,     \
                     TYPE u, __global const real *image, __global const real *grad,                \
                     __global const uchar *layers, __global real *grad_image, TYPE *sums)          \
    {                                                                                              \
        TYPE light[3], by[3], slopes[3], by_curve[3][TONE_TERMS];                                  \
        const TYPE clear = WITH_FRONT ? BYTES(layers + FRONT_CLEAR_PLANE * plane) : 1;             \
        for (int k = 0; k < 3; k++) {                                                              \
            light[k] = LOAD(0, image + k * plane);                                                 \
            if (WITH_FRONT)                                                                        \
                light[k] = clear * light[k] + BYTES(layers + (FRONT_PLANE + k) * plane);           \
            if (WITH_TONE)                                                                         \
                light[k] = to_light##SUFFIX(light[k], curve, slopes + k, by_curve[k]);             \
            by[k] = 0;                                                                             \
        }                                                                                          \
        const TYPE gain = WITH_VIGNETTING ? GAIN(lens, u) : 1;                                     \
        for (int k = 0; k < 3; k++) {                                                              \
            TYPE grad_k = LOAD(0, grad + k * plane);                                               \
            if (WITH_TONE) {                                                                       \
                TYPE slope, by_own[TONE_TERMS], mixed = 0;                                         \
                for (int j = 0; j < 3; j++)                                                        \
                    mixed += e[4 * k + j] * light[j];                                              \
                from_light##SUFFIX(gain * mixed + e[4 * k + 3], curve, &slope, by_own);            \
                for (int j = 0; j < TONE_TERMS; j++)                                               \
                    sums[TONE_SUM + j] += grad_k * by_own[j];                                      \
                grad_k *= slope;                                                                   \
            }                                                                                      \
            const TYPE gained = grad_k * gain;                                                     \
            for (int j = 0; j < 3; j++) {                                                          \
                by[j] += e[4 * k + j] * grad_k;                                                    \
                sums[4 * k + j] += gained * light[j];                                              \
            }                                                                                      \
            sums[4 * k + 3] += grad_k;                                                             \
        }                                                                                          \
        for (int k = 0; k < 3; k++) {                                                              \
            TYPE result = gain * by[k];                                                            \
            if (WITH_TONE) {                                                                       \
                for (int j = 0; j < TONE_TERMS; j++)                                               \
                    sums[TONE_SUM + j] += result * by_curve[k][j];                                 \
                result *= slopes[k];                                                               \
            }                                                                                      \
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
DEFINE_CURVE(1, real)
DEFINE_PIXELS(pixels1, 1, real, LOAD_ONE, STORE_ONE, ONE_BYTE)

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

// One step on the row of `view`, and on those of its lens that are learned: numbers that only count
// if all are finite; else all rows stay and `skipped` counts it. The loss has the penalties pull
// mean((E - I)^2), pull mean((a, b, c)^2) of the vignetting and TONE_PULL pull mean((a, b)^2) of
// the tone curve beside the image's gradient, the sum of `partials`; the bias corrections go by the
// row's own steps. Bends stay within TONE_MOST. m, v: real[V, TRANSFORM_REALS]; steps: uint[V];
// lens_m, lens_v, tone_m, tone_v: the same for lenses; lens_steps: uint[L]. One group, in both
// forms: each of PARTS items adds up every PARTS-th row, and one item the rest. A frame that has
// failed changes nothing.
#define PARTS 16
__kernel __attribute__((reqd_work_group_size(PARTS, 1, 1)))
void exposure_step(uint view, real rate, real pull, __global const uint *restrict counts,
                   __global const real *restrict partials, uint blocks,
                   __global real *restrict transforms, __global real *restrict m,
                   __global real *restrict v, __global uint *restrict steps,
                   __global const uint *restrict lens_of, __global real *restrict lenses,
                   __global real *restrict tones, __global real *restrict lens_m,
                   __global real *restrict lens_v, __global real *restrict tone_m,
                   __global real *restrict tone_v, __global uint *restrict lens_steps,
                   __global uint *restrict skipped)
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
    tones += lens * TONE_TERMS;
    real gradient[EXPOSURE_SUMS];
    for (int k = 0; k < EXPOSURE_SUMS; k++) {
        if (k < TRANSFORM_REALS)
            gradient[k] = pull * 2 / TRANSFORM_REALS * (transforms[k] - (k % 5 == 0 ? 1 : 0));
        else if (k < TONE_SUM)
            gradient[k] = pull * 2 / VIGNETTING_TERMS * lenses[k - TRANSFORM_REALS];
        else
            gradient[k] = pull * (real)TONE_PULL * 2 / TONE_TERMS * tones[k - TONE_SUM];
        for (int p = 0; p < PARTS; p++)
            gradient[k] += sums[p][k];
        if (!isfinite(gradient[k] * gradient[k])) { // an infinite v would never heal
            ++*skipped;
            return;
        }
    }
    adam_row(gradient, TRANSFORM_REALS, ++steps[view], rate, transforms, m + view * TRANSFORM_REALS,
             v + view * TRANSFORM_REALS);
    if (WITH_VIGNETTING || WITH_TONE)
        ++lens_steps[lens];
    if (WITH_VIGNETTING)
        adam_row(gradient + TRANSFORM_REALS, VIGNETTING_TERMS, lens_steps[lens], rate, lenses,
                 lens_m + lens * VIGNETTING_TERMS, lens_v + lens * VIGNETTING_TERMS);
    if (WITH_TONE) {
        adam_row(gradient + TONE_SUM, TONE_TERMS, lens_steps[lens], rate, tones,
                 tone_m + lens * TONE_TERMS, tone_v + lens * TONE_TERMS);
        for (int k = 0; k < TONE_TERMS; k++)
            tones[k] = clamp(tones[k], -(real)TONE_MOST, (real)TONE_MOST);
    }
}
