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

// exp for the powers that matter, -6 to 0: rounding the exponent out leaves 2^f with |f| <= 1/2,
// where a degree-6 polynomial (our least-squares fit of 2^f, relative error 3e-9) is exact to
// rounding. A device whose native_exp was seen accurate uses that instead.
inline vreal exp_power(vreal x)
{
#if REAL_IS_DOUBLE
    return exp(x);
#elif HAVE_NATIVE_EXP && !FORM_ITEM
    return native_exp(x);
#else
    // adding 1.5 2^23 rounds to an integer and leaves it in the low bits
    const vreal t = max(x, (vreal)-87) * (vreal)1.4426950408889634;
    const vreal shifted = t + (vreal)12582912;
    const vreal f = t - (shifted - (vreal)12582912);
    vreal p = 0.00015343758673529777;
    p = mad(p, f, (vreal)0.001340530186465684);
    p = mad(p, f, (vreal)0.009618545002468079);
    p = mad(p, f, (vreal)0.05550313243528009);
    p = mad(p, f, (vreal)0.24022645717156282);
    p = mad(p, f, (vreal)0.6931472143763362);
    p = mad(p, f, (vreal)1.0000000008587457);
    return p * AS_VREAL((AS_INTS(shifted) + 127) << 23);
#endif
}

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
