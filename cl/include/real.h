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
#define convert_real16 convert_float16
#endif

// Sum of the elements, always in this order, whatever the compiler would prefer.
inline real sum16(real16 v)
{
    real8 a = v.lo + v.hi;
    real4 b = a.lo + a.hi;
    real2 c = b.lo + b.hi;
    return c.x + c.y;
}
