// A colour transform a training view, c' = M c + t, learned beside the gaussians: photos drift in
// brightness and white balance (an affine colour map a photo, as Kerbl et al. 2024 use).
// transforms: real[V, 12], a row [M | t] in row-major order; images and gradients: real[3, H, W],
// pixels = H W; partials: real[blocks, 12], sums over BLOCK pixels each, added up by reduce.cl
// (blocks of a fixed size: the same order of additions on any number of cores, and short sums).
#include "real.h"
#include "each.h"

#define ENTRIES 12
#define LOAD_ONE(OFFSET, P) (*(P))
#define STORE_ONE(VALUE, OFFSET, P) (*(P) = (VALUE))

__kernel void exposure_apply(uint pixels, uint view, __global const real *restrict transforms,
                             __global const real *restrict image, __global real *restrict result)
{
    real e[ENTRIES];
    for (int k = 0; k < ENTRIES; k++)
        e[k] = transforms[view * ENTRIES + k];
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

// Item form: a work-item walks blocks, 16 pixels at a time. Group form: a group owns a block.
#if FORM_ITEM
DEFINE_PIXELS(pixels16, real16, vload16, vstore16)

__kernel void exposure_adjoint(uint pixels, uint view, uint blocks,
                               __global const real *restrict transforms,
                               __global const real *restrict image,
                               __global const real *restrict grad,
                               __global real *restrict grad_image, __global real *restrict partials)
{
    real e[ENTRIES];
    for (int k = 0; k < ENTRIES; k++)
        e[k] = transforms[view * ENTRIES + k];
    FOR_EACH(block, blocks) {
        real16 wide[ENTRIES];
        real rest[ENTRIES];
        for (int k = 0; k < ENTRIES; k++)
            wide[k] = rest[k] = 0;
        ulong p = block * BLOCK;
        const ulong end = min(p + BLOCK, (ulong)pixels);
        for (; p + 16 <= end; p += 16)
            pixels16(pixels, e, image + p, grad + p, grad_image + p, wide);
        for (; p < end; p++)
            pixels1(pixels, e, image + p, grad + p, grad_image + p, rest);
        for (int k = 0; k < ENTRIES; k++)
            partials[block * ENTRIES + k] = sum16(wide[k]) + rest[k];
    }
}
#else
#include "group.h"
DEFINE_LANE_SUM(lane_sum, real)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void exposure_adjoint(uint pixels, uint view, uint blocks, __global const real *restrict transforms,
                      __global const real *restrict image, __global const real *restrict grad,
                      __global real *restrict grad_image, __global real *restrict partials)
{
    __local real scratch[LANES];
    const ulong block = get_group_id(0), begin = block * BLOCK;
    real e[ENTRIES], sums[GROUP_LANES][ENTRIES], lanes[GROUP_LANES];
    for (int k = 0; k < ENTRIES; k++) {
        e[k] = transforms[view * ENTRIES + k];
        for (uint own = 0; own < GROUP_LANES; own++)
            sums[own][k] = 0;
    }
    FOR_LANES(i, own, min((ulong)BLOCK, pixels - begin)) {
        const ulong p = begin + i;
        pixels1(pixels, e, image + p, grad + p, grad_image + p, sums[own]);
    }
    for (int k = 0; k < ENTRIES; k++) {
        for (uint own = 0; own < GROUP_LANES; own++)
            lanes[own] = sums[own][k];
        const real total = lane_sum(lanes, scratch);
        if (get_local_id(0) == 0)
            partials[block * ENTRIES + k] = total;
    }
}
#endif

// One step of Adam (Kingma & Ba 2015) on the row of `view`, by one work-item: twelve numbers that
// only count if all are finite; else the row stays and `skipped` counts it. The loss has the penalty
// pull mean((E - I)^2) beside the image's gradient `totals`; the bias corrections go by the row's own
// steps. m, v: real[V, 12], counts: uint[V]. log(beta) and 1 - beta are written out: in single
// precision 1 - 0.999^t loses digits.
#define ONE_MINUS_BETA1 0.1
#define ONE_MINUS_BETA2 0.001
#define LOG_BETA1 -0.10536051565782628
#define LOG_BETA2 -0.0010005003335835344
#define EPSILON 1e-15

__kernel void exposure_step(uint view, real rate, real pull, __global const real *restrict totals,
                            __global real *restrict transforms, __global real *restrict m,
                            __global real *restrict v, __global uint *restrict counts,
                            __global uint *restrict skipped)
{
    if (get_global_id(0) > 0)
        return;
    transforms += view * ENTRIES;
    m += view * ENTRIES;
    v += view * ENTRIES;
    real gradient[ENTRIES];
    for (int k = 0; k < ENTRIES; k++) {
        const real from_identity = transforms[k] - (k % 5 == 0 ? 1 : 0);
        gradient[k] = totals[k] + pull * 2 / ENTRIES * from_identity;
        if (!isfinite(gradient[k] * gradient[k])) { // an infinite v would never heal
            ++*skipped;
            return;
        }
    }
    const uint step = ++counts[view];
    const real correction1 = -expm1(step * (real)LOG_BETA1);
    const real correction2 = -expm1(step * (real)LOG_BETA2);
    for (int k = 0; k < ENTRIES; k++) {
        const real g = gradient[k];
        m[k] += (real)ONE_MINUS_BETA1 * (g - m[k]);
        v[k] += (real)ONE_MINUS_BETA2 * (g * g - v[k]);
        transforms[k] -= rate * (m[k] / correction1) / (sqrt(v[k] / correction2) + (real)EPSILON);
    }
}
