// Adam's moments in memory: as reals, or those of the harmonics in 16 bits each (HALF_MOMENTS).
//
// In 16 bits: the root s of v as a float of 6 bits of exponent and 10 of mantissa without sign,
// 2^-54 to 2^10, 0 for less; m as the half m / s, whose size is at most 7.3 (adam.cl), so that no
// scale is needed. A step of Adam changes s by less than its last digit: rounding to nearest would
// hold it where it is, so it is rounded up or down by a hash of element and step, in the mean
// right.
#define DEFINE_REALS(NAME, S, LOAD, STORE)                                                         \
    inline void load_reals##NAME(__global const real *m, __global const real *v, real##S *first,   \
                                 real##S *second)                                                  \
    {                                                                                              \
        *first = LOAD(0, m);                                                                       \
        *second = LOAD(0, v);                                                                      \
    }                                                                                              \
    inline void store_reals##NAME(real##S first, real##S second, uint seed, __global real *m,      \
                                  __global real *v)                                                \
    {                                                                                              \
        STORE(first, 0, m);                                                                        \
        STORE(second, 0, v);                                                                       \
    }
DEFINE_REALS(1, , LOAD_ONE, STORE_ONE)
DEFINE_REALS(3, 3, vload3, vstore3)
DEFINE_REALS(4, 4, vload4, vstore4)
DEFINE_REALS(16, 16, vload16, vstore16)

#if HALF_MOMENTS
#if REAL_IS_DOUBLE
#define CONVERT_REAL(S) convert_double##S
#else
#define CONVERT_REAL(S) convert_float##S
#endif
#define ROOT_SHIFT 13 // bits of a float's mantissa that are dropped
#define ROOT_BASE (73u << 10) // of the exponent -54
#define MOST_RATIO 60000.0f

#define DEFINE_HALVES(NAME, S, LOAD, STORE, PLACES)                                                \
    inline float##S root_of##NAME(uint##S code)                                                    \
    {                                                                                              \
        return select(as_float##S((code + ROOT_BASE) << ROOT_SHIFT), (float##S)(0), code == 0);    \
    }                                                                                              \
    inline void load_halves##NAME(__global const ushort *m, __global const ushort *v,              \
                                  real##S *first, real##S *second)                                 \
    {                                                                                              \
        const float##S root = root_of##NAME(convert_uint##S(LOAD(0, v)));                          \
        *first = CONVERT_REAL(S)(vload_half##S(0, (__global const half *)m) * root);               \
        *second = CONVERT_REAL(S)(root * root);                                                    \
    }                                                                                              \
    inline void store_halves##NAME(real##S first, real##S second, uint seed, __global ushort *m,   \
                                   __global ushort *v)                                             \
    {                                                                                              \
        uint##S hash = (seed + PLACES) * 0x7FEB352Du;                                              \
        hash = (hash ^ hash >> 15) * 0x846CA68Bu;                                                  \
        hash = (hash ^ hash >> 16) & ((1u << ROOT_SHIFT) - 1);                                     \
        uint##S code = (as_uint##S(convert_float##S(sqrt(second))) + hash) >> ROOT_SHIFT;          \
        code = min(max(code, (uint##S)(ROOT_BASE)) - ROOT_BASE, (uint##S)(0xFFFF));                \
        const float##S root = root_of##NAME(code);                                                 \
        const float##S ratio = convert_float##S(first) / fmax(root, (float##S)(1e-30f));           \
        STORE(convert_ushort##S(code), 0, v);                                                      \
        vstore_half##S(clamp(ratio, (float##S)(-MOST_RATIO), (float##S)(MOST_RATIO)), 0,           \
                       (__global half *)m);                                                        \
    }
DEFINE_HALVES(1, , LOAD_ONE, STORE_ONE, 0)
#if FORM_ITEM
DEFINE_HALVES(4, 4, vload4, vstore4, (uint4)(0, 1, 2, 3))
DEFINE_HALVES(16, 16, vload16, vstore16,
              (uint16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15))
#endif
#define LOAD_MOMENTS(WIDTH) load_halves##WIDTH
#define STORE_MOMENTS(WIDTH) store_halves##WIDTH
#else
#define LOAD_MOMENTS(WIDTH) load_reals##WIDTH
#define STORE_MOMENTS(WIDTH) store_reals##WIDTH
#endif
