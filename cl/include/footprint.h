// Alpha of a splat at a pixel, or at a row of 16 pixels (vector.h).
#include "vector.h"
#include "exp_power.h"
#ifndef SMOOTH_CUTOFF
#define SMOOTH_CUTOFF 0
#endif

// The contribution of a splat given its unclamped alpha. In tests (SMOOTH_CUTOFF) the step at
// ALPHA_MIN becomes a ramp, so that finite differences across it have a meaning.
inline vreal cut_alpha(vreal raw)
{
#if SMOOTH_CUTOFF
    const vreal u = clamp((raw - ALPHA_MIN) / ALPHA_MIN, (vreal)0, (vreal)1);
    raw *= u * u * (3 - 2 * u);
#endif
    return min((vreal)ALPHA_MAX, raw);
}

// d cut_alpha / d raw, zero where the clamp at ALPHA_MAX holds.
inline vreal cut_alpha_slope(vreal raw)
{
#if SMOOTH_CUTOFF
    const vreal u = clamp((raw - ALPHA_MIN) / ALPHA_MIN, (vreal)0, (vreal)1);
    const vreal ramp = u * u * (3 - 2 * u);
    const vreal slope = ramp + raw * 6 * u * (1 - u) / ALPHA_MIN;
    return select(slope, (vreal)0, TO_MASK(raw * ramp > (vreal)ALPHA_MAX));
#else
    return select((vreal)1, (vreal)0, TO_MASK(raw > (vreal)ALPHA_MAX));
#endif
}

#define LOG2_E 1.4426950408889634
#if FORM_ITEM
// Declares what the rows of a tile share of a splat, its columns at the pixels x of type real16. In
// a row at distance dy = y - mean_y, excess_x + dy (c dy - shear) is the excess: the binary
// logarithm of alpha / ALPHA_MIN. Below zero a pixel is skipped; `alpha_of` is alpha before it is
// cut.
#define SPLAT_IN_ROWS(INDEX)                                                                       \
    __global const real *splat = splats + (ulong)(INDEX) * SPLAT_REALS;                            \
    const real mean_y = splat[SPLAT_MEAN + 1];                                                     \
    const real a = (real)(-0.5 * LOG2_E) * splat[SPLAT_CONIC];                                     \
    const real b = (real)LOG2_E * splat[SPLAT_CONIC + 1];                                          \
    const real c = (real)(-0.5 * LOG2_E) * splat[SPLAT_CONIC + 2];                                 \
    const real16 dx = x - splat[SPLAT_MEAN], shear = b * dx;                                       \
    const real16 excess_x = a * dx * dx + (real)(0.5 * LOG2_E) * splat[SPLAT_CUTOFF]
inline real16 alpha_of(real16 excess)
{
    return exp2_scaled(excess, (real)ALPHA_MIN);
}
#endif
