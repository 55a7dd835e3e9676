// The only place where precision is switched. Float builds read every literal as single.
#ifndef REAL_IS_DOUBLE
#error "REAL_IS_DOUBLE must be 0 or 1"
#endif
#if REAL_IS_DOUBLE
#pragma OPENCL EXTENSION cl_khr_fp64 : enable
typedef double real;
typedef double2 real2;
typedef double3 real3;
typedef double4 real4;
typedef double8 real8;
typedef double16 real16;
typedef long16 mask16; // what comparing two real16 gives
#define convert_mask16 convert_long16
#define convert_real convert_double
#define convert_real3 convert_double3
#define convert_real4 convert_double4
#define convert_real16 convert_double16
#else
typedef float real;
typedef float2 real2;
typedef float3 real3;
typedef float4 real4;
typedef float8 real8;
typedef float16 real16;
typedef int16 mask16;
#define convert_mask16 convert_int16
#define convert_real convert_float
#define convert_real3 convert_float3
#define convert_real4 convert_float4
#define convert_real16 convert_float16
#endif

// A B + C: one operation where the device has it, and then the same in every kernel.
#if REAL_IS_DOUBLE ? defined(FP_FAST_FMA) : defined(FP_FAST_FMAF)
#define MAD(A, B, C) fma(A, B, C)
#else
#define MAD(A, B, C) ((A) * (B) + (C))
#endif

// For functions of structs: PoCL leaves some of them functions, and then copies the structs.
#if HAVE_PREFETCH // the interpreter of oclgrind runs neither that nor what inlining leaves
#define INLINE inline __attribute__((always_inline))
#else
#define INLINE inline
#endif

// Sum of the elements, always in this order, whatever the compiler would prefer.
inline real sum16(real16 v)
{
    real8 a = v.lo + v.hi;
    real4 b = a.lo + a.hi;
    real2 c = b.lo + b.hi;
    return c.x + c.y;
}

// The sums of eight vectors at once: halving them together takes a third of the additions.
inline real8 sum16_each(real16 v0, real16 v1, real16 v2, real16 v3, real16 v4, real16 v5, real16 v6,
                        real16 v7)
{
    const real8 a0 = v0.lo + v0.hi, a1 = v1.lo + v1.hi, a2 = v2.lo + v2.hi, a3 = v3.lo + v3.hi;
    const real8 a4 = v4.lo + v4.hi, a5 = v5.lo + v5.hi, a6 = v6.lo + v6.hi, a7 = v7.lo + v7.hi;
    const real8 b0 = (real8)(a0.lo, a1.lo) + (real8)(a0.hi, a1.hi);
    const real8 b1 = (real8)(a2.lo, a3.lo) + (real8)(a2.hi, a3.hi);
    const real8 b2 = (real8)(a4.lo, a5.lo) + (real8)(a4.hi, a5.hi);
    const real8 b3 = (real8)(a6.lo, a7.lo) + (real8)(a6.hi, a7.hi);
    const real8 c0 = (real8)(b0.s0145, b1.s0145) + (real8)(b0.s2367, b1.s2367);
    const real8 c1 = (real8)(b2.s0145, b3.s0145) + (real8)(b2.s2367, b3.s2367);
    return (real8)(c0.even, c1.even) + (real8)(c0.odd, c1.odd);
}

// Whether any element of a comparison holds. Spelled out: PoCL's any() takes each element by
// itself.
inline bool any16(mask16 v)
{
#if REAL_IS_DOUBLE
    long8 a = v.lo | v.hi;
    long4 b = a.lo | a.hi;
    long2 c = b.lo | b.hi;
#else
    int8 a = v.lo | v.hi;
    int4 b = a.lo | a.hi;
    int2 c = b.lo | b.hi;
#endif
    return (c.x | c.y) != 0;
}
