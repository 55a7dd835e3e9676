// How Adam's moments are stored: as real numbers, or, in builds with CODED, in three bytes in place
// of eight. m is then the upper half of a float (bfloat16), and v its exponent and one bit of its
// mantissa, from 2^-110 to 2^17, where 0 stays 0. They are rounded up or down at random, so that
// the mean is right: to the nearest, v would never change, as a step moves it by a thousandth. A
// hash of the element and the step is the source of randomness, so that runs can be repeated
// (Dettmers et al. 2022, "8-bit Optimizers", store blocks with a common scale; ours need none).
#if CODED
#define FIRST_MOMENT ushort
#define SECOND_MOMENT uchar
#else
#define FIRST_MOMENT real
#define SECOND_MOMENT real
#endif
#define SECOND_SHIFT 22 // bits of a float that the code of v lacks
#define SECOND_BASE 33u // the code of 2^-110 is 1

// Random bits of an element, by its number.
#define DEFINE_NOISE(S)                                                                            \
    inline uint##S noise_of##S(uint##S element, uint now)                                          \
    {                                                                                              \
        uint##S h = element * 0x9e3779b1u + now * 0x85ebca77u;                                     \
        h = (h ^ (h >> 15)) * 0x2c1b3c6du;                                                         \
        h = (h ^ (h >> 12)) * 0x297a2d39u;                                                         \
        return h ^ (h >> 15);                                                                      \
    }

// The number that a code stands for, and a code of a number, for `S` elements at once; none is one.
#if CODED
#define DEFINE_CODES(S)                                                                            \
    DEFINE_NOISE(S)                                                                                \
    inline real##S first_of##S(ushort##S code)                                                     \
    {                                                                                              \
        return convert_real##S(as_float##S(convert_uint##S(code) << 16u));                         \
    }                                                                                              \
    inline ushort##S first_code##S(real##S value, uint##S noise)                                   \
    {                                                                                              \
        return convert_ushort##S((as_uint##S(convert_float##S(value)) + (noise >> 16u)) >> 16u);   \
    }                                                                                              \
    inline real##S second_of##S(uchar##S code)                                                     \
    {                                                                                              \
        const uint##S bits = convert_uint##S(code);                                                \
        return convert_real##S(as_float##S(                                                        \
            select((bits + SECOND_BASE) << SECOND_SHIFT, (uint##S)(0), bits == 0u)));              \
    }                                                                                              \
    inline uchar##S second_code##S(real##S value, uint##S noise)                                   \
    {                                                                                              \
        const uint##S bits = as_uint##S(convert_float##S(value));                                  \
        const uint##S code =                                                                       \
            (bits + (noise & ((1u << SECOND_SHIFT) - 1u))) >> SECOND_SHIFT;                        \
        return convert_uchar##S(select(                                                            \
            clamp(code, (uint##S)(SECOND_BASE + 1u), (uint##S)(SECOND_BASE + 255u)) - SECOND_BASE, \
            (uint##S)(0), bits == 0u));                                                            \
    }
#else
#define DEFINE_CODES(S)                                                                            \
    DEFINE_NOISE(S)                                                                                \
    inline real##S first_of##S(real##S value)                                                      \
    {                                                                                              \
        return value;                                                                              \
    }                                                                                              \
    inline real##S first_code##S(real##S value, uint##S noise)                                     \
    {                                                                                              \
        return value;                                                                              \
    }                                                                                              \
    inline real##S second_of##S(real##S value)                                                     \
    {                                                                                              \
        return value;                                                                              \
    }                                                                                              \
    inline real##S second_code##S(real##S value, uint##S noise)                                    \
    {                                                                                              \
        return value;                                                                              \
    }
#endif
DEFINE_CODES()
