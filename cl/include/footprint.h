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
