// Alpha of a splat at a pixel, for a scalar (group form) or a row of 16 pixels (item form).
// vreal: the width; vmask: what comparing two of them gives.
#if FORM_ITEM
typedef real16 vreal;
typedef mask16 vmask;
#define TO_MASK convert_mask16
#define AS_INTS as_int16
#define AS_VREAL as_float16
#else
typedef real vreal;
#if REAL_IS_DOUBLE
typedef long vmask;
#else
typedef int vmask;
#endif
#define TO_MASK (vmask)
#define AS_INTS as_int
#define AS_VREAL as_float
#endif

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
