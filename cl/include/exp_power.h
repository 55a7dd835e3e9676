// The exponential of the powers that matter, -6 to 0, of the width `vreal`. EXP_KIND, a choice at
// build time: 0 exp2, 1 native_exp2, 3 to 6 the degree of our polynomial
// (docs/evidence/numerics.md).
// Default: degree 4 in the item form, whose error is that of float; in the group form native_exp2
// where it was seen accurate, else degree 6.
#ifndef EXP_KIND
#if FORM_ITEM
#define EXP_KIND 4
#elif HAVE_NATIVE_EXP
#define EXP_KIND 1
#else
#define EXP_KIND 6
#endif
#endif

// The polynomial of 2^f, |f| <= 1/2, times a constant: ours of degree 3, 4, 5 (least maximum) and 6
// (least squares), whose largest relative errors are 7.5e-5, 2.6e-6, 7.5e-8 and 3e-9; the last is
// exact to rounding. Compilers fuse these products and sums; PoCL's mad is two operations.
#if !REAL_IS_DOUBLE && EXP_KIND > 1
inline vreal exp2_of_fraction(vreal f, real scale)
{
#if EXP_KIND == 3
    vreal p = scale * (real)0.05517166802352585;
    p = p * f + scale * (real)0.24261112211402186;
    p = p * f + scale * (real)0.693260985651579;
    return p * f + scale * (real)0.9999280735491466;
#elif EXP_KIND == 4
    vreal p = scale * (real)0.009570101791602465;
    p = p * f + scale * (real)0.05591786031001489;
    p = p * f + scale * (real)0.24024744830816624;
    p = p * f + scale * (real)0.6931218147384373;
    return p * f + scale * (real)0.9999992614448237;
#elif EXP_KIND == 5
    vreal p = scale * (real)0.0013276471871201034;
    p = p * f + scale * (real)0.00967554133345555;
    p = p * f + scale * (real)0.05550713273871266;
    p = p * f + scale * (real)0.24022119723864352;
    p = p * f + scale * (real)0.6931469670645334;
    return p * f + scale * (real)1.0000000716546764;
#elif EXP_KIND == 6
    vreal p = scale * (real)0.00015343758673529777;
    p = p * f + scale * (real)0.001340530186465684;
    p = p * f + scale * (real)0.009618545002468079;
    p = p * f + scale * (real)0.05550313243528009;
    p = p * f + scale * (real)0.24022645717156282;
    p = p * f + scale * (real)0.6931472143763362;
    return p * f + scale * (real)1.0000000008587457;
#else
#error "EXP_KIND must be 0, 1 or 3 to 6"
#endif
}
#endif

#define ROUNDING 12582912.0 // adding 1.5 2^23 rounds to an integer and leaves it in the low bits
#if FORM_ITEM
// scale 2^x, the scale a constant, for -80 < x < 80; anything elsewhere. The integer is added to
// the exponent of what the polynomial gives.
inline vreal exp2_scaled(vreal x, real scale)
{
#if REAL_IS_DOUBLE || EXP_KIND == 0
    return scale * exp2(x);
#elif EXP_KIND == 1
    return scale * native_exp2(x);
#else
    const vreal shifted = x + (vreal)ROUNDING;
    const vreal p = exp2_of_fraction(x - (shifted - (vreal)ROUNDING), scale);
    return AS_VREAL(AS_INTS(p) + (AS_INTS(shifted) << 23));
#endif
}
#else
// 2^x; 0 where not `live`, by what goes in: a branch around it would cost more.
inline vreal exp2_where(bool live, vreal x)
{
#if REAL_IS_DOUBLE || EXP_KIND == 0
    return exp2(live ? x : (vreal)-INFINITY);
#elif EXP_KIND == 1
    return native_exp2(live ? x : (vreal)-INFINITY);
#else
    if (!live)
        return 0;
    const vreal t = max(x, (vreal)-125);
    const vreal shifted = t + (vreal)ROUNDING;
    const vreal p = exp2_of_fraction(t - (shifted - (vreal)ROUNDING), 1);
    return p * AS_VREAL((AS_INTS(shifted) + 127) << 23);
#endif
}
#endif
