// exp for the powers that matter, -6 to 0, of the width `vreal`. EXP_KIND, a choice at build time:
// 0 exp, 1 native_exp, 3 to 6 the degree of our polynomial (docs/notebook/numerics.md).
// Default: native_exp in the group form where it was seen accurate, else degree 6.
#ifndef EXP_KIND
#if HAVE_NATIVE_EXP && !FORM_ITEM
#define EXP_KIND 1
#else
#define EXP_KIND 6
#endif
#endif

// The polynomial: rounding the exponent out leaves 2^f with |f| <= 1/2, which a polynomial fits: ours
// of degree 3, 4, 5 (least maximum) and 6 (least squares), whose largest relative errors are 7.5e-5,
// 2.6e-6, 7.5e-8 and 3e-9; the last is exact to rounding.
inline vreal exp_power(vreal x)
{
#if REAL_IS_DOUBLE || EXP_KIND == 0
    return exp(x);
#elif EXP_KIND == 1
    return native_exp(x);
#else
    // adding 1.5 2^23 rounds to an integer and leaves it in the low bits
    const vreal t = max(x, (vreal)-87) * (vreal)1.4426950408889634;
    const vreal shifted = t + (vreal)12582912;
    const vreal f = t - (shifted - (vreal)12582912);
#if EXP_KIND == 3
    vreal p = 0.05517166802352585;
    p = mad(p, f, (vreal)0.24261112211402186);
    p = mad(p, f, (vreal)0.693260985651579);
    p = mad(p, f, (vreal)0.9999280735491466);
#elif EXP_KIND == 4
    vreal p = 0.009570101791602465;
    p = mad(p, f, (vreal)0.05591786031001489);
    p = mad(p, f, (vreal)0.24024744830816624);
    p = mad(p, f, (vreal)0.6931218147384373);
    p = mad(p, f, (vreal)0.9999992614448237);
#elif EXP_KIND == 5
    vreal p = 0.0013276471871201034;
    p = mad(p, f, (vreal)0.00967554133345555);
    p = mad(p, f, (vreal)0.05550713273871266);
    p = mad(p, f, (vreal)0.24022119723864352);
    p = mad(p, f, (vreal)0.6931469670645334);
    p = mad(p, f, (vreal)1.0000000716546764);
#elif EXP_KIND == 6
    vreal p = 0.00015343758673529777;
    p = mad(p, f, (vreal)0.001340530186465684);
    p = mad(p, f, (vreal)0.009618545002468079);
    p = mad(p, f, (vreal)0.05550313243528009);
    p = mad(p, f, (vreal)0.24022645717156282);
    p = mad(p, f, (vreal)0.6931472143763362);
    p = mad(p, f, (vreal)1.0000000008587457);
#else
#error "EXP_KIND must be 0, 1 or 3 to 6"
#endif
    return p * AS_VREAL((AS_INTS(shifted) + 127) << 23);
#endif
}
