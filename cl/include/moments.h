// How Adam's moments are stored: as real numbers, or, in builds with CODED, in three bytes in place
// of eight. Then m keeps sign, exponent and 3 bits of the mantissa of a float, and v exponent and
// 4 bits: the first code is m and the last 4 bits of v, the second one the others of v. They are
// rounded up or down at random, so that the mean is right: to the nearest, v would never change,
// as a step moves it by a thousandth. A hash of the element and the step is the source of
// randomness, so that runs can be repeated. (Dettmers et al. 2022, 8-bit Optimizers, store blocks
// with a common scale; ours need none. With 8 bits of v alone, boruszyn lost 0.2 dB.)
#if CODED
#define FIRST_MOMENT ushort
#define SECOND_MOMENT uchar
#else
#define FIRST_MOMENT real
#define SECOND_MOMENT real
#endif
#define M_SHIFT 20 // bits of a float that a code lacks
#define V_SHIFT 19
#define V_BITS 4 // of v in the first code

// Random bits of an element, by its number; m takes the upper ones, v the lower ones.
#define DEFINE_NOISE(S)                                                                            \
    inline uint##S noise_of##S(uint##S element, uint now)                                          \
    {                                                                                              \
        uint##S h = element * 0x9e3779b1u + now * 0x85ebca77u;                                     \
        h = (h ^ (h >> 15)) * 0x2c1b3c6du;                                                         \
        h = (h ^ (h >> 12)) * 0x297a2d39u;                                                         \
        return h ^ (h >> 15);                                                                      \
    }

// The moments that two codes stand for, and the codes of moments, for `S` elements at once; none is
// one.
#if CODED
#define DEFINE_CODES(S)                                                                            \
    DEFINE_NOISE(S)                                                                                \
    inline real##S m_of##S(ushort##S first)                                                        \
    {                                                                                              \
        return convert_real##S(                                                                    \
            as_float##S((convert_uint##S(first) >> V_BITS) << M_SHIFT));                           \
    }                                                                                              \
    inline real##S v_of##S(ushort##S first, uchar##S second)                                       \
    {                                                                                              \
        const uint##S bits = (convert_uint##S(second) << V_BITS) |                                 \
                             (convert_uint##S(first) & ((1u << V_BITS) - 1u));                     \
        return convert_real##S(as_float##S(bits << V_SHIFT));                                      \
    }                                                                                              \
    inline uint##S v_bits##S(real##S v, uint##S noise)                                             \
    {                                                                                              \
        return (as_uint##S(convert_float##S(v)) + (noise & ((1u << V_SHIFT) - 1u))) >> V_SHIFT;    \
    }                                                                                              \
    inline ushort##S first_code##S(real##S m, real##S v, uint##S noise)                            \
    {                                                                                              \
        const uint##S bits =                                                                       \
            (as_uint##S(convert_float##S(m)) + (noise >> (32u - M_SHIFT))) >> M_SHIFT;             \
        return convert_ushort##S((bits << V_BITS) |                                                \
                                 (v_bits##S(v, noise) & ((1u << V_BITS) - 1u)));                   \
    }                                                                                              \
    inline uchar##S second_code##S(real##S v, uint##S noise)                                       \
    {                                                                                              \
        return convert_uchar##S(v_bits##S(v, noise) >> V_BITS);                                    \
    }
#else
#define DEFINE_CODES(S)                                                                            \
    DEFINE_NOISE(S)                                                                                \
    inline real##S m_of##S(real##S first)                                                          \
    {                                                                                              \
        return first;                                                                              \
    }                                                                                              \
    inline real##S v_of##S(real##S first, real##S second)                                          \
    {                                                                                              \
        return second;                                                                             \
    }                                                                                              \
    inline real##S first_code##S(real##S m, real##S v, uint##S noise)                              \
    {                                                                                              \
        return m;                                                                                  \
    }                                                                                              \
    inline real##S second_code##S(real##S v, uint##S noise)                                        \
    {                                                                                              \
        return v;                                                                                  \
    }
#endif
DEFINE_CODES()
