// Alpha of a splat at a pixel, or at a row of 16 pixels (vector.h).
#include "vector.h"
#include "exp_power.h"

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

// Declares what the rows of a tile share of a splat, its columns at the pixels x of type real16. In a row
// at distance dy = y - mean_y the power is power_x + dy (c dy - shear), and nothing is below `cut`.
#define SPLAT_IN_ROWS(INDEX)                                                                       \
    __global const real *splat = splats + (ulong)(INDEX) * SPLAT_REALS;                            \
    const real cut = -0.5 * splat[SPLAT_CUTOFF], opacity = splat[SPLAT_OPACITY];                   \
    const real a = -0.5 * splat[SPLAT_CONIC], b = splat[SPLAT_CONIC + 1];                          \
    const real c = -0.5 * splat[SPLAT_CONIC + 2], mean_y = splat[SPLAT_MEAN + 1];                  \
    const real16 dx = x - splat[SPLAT_MEAN];                                                       \
    const real16 power_x = a * dx * dx, shear = b * dx
