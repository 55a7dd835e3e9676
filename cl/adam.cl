// One Adam step (Kingma & Ba 2015) on one field; bias corrections are folded into the arguments:
//
//   m <- m + (1 - beta1)(g - m);   v <- v + (1 - beta2)(g^2 - v)
//   parameter <- parameter - rate m / (sqrt(v) / root_correction + epsilon)
//
// with rate = learning rate / (1 - beta1^t), root_correction = sqrt(1 - beta2^t). parameter, m, v:
// real[N, stride]; gradient: real[V, stride]; only the first `used` columns of a row are touched
// (harmonics not yet active stay out). One work-item an element, one writer each.
#include "real.h"
#define NO_ROW UINT_MAX
#define ONE_MINUS_BETA1 0.1 // written out: in single precision the difference loses digits
#define ONE_MINUS_BETA2 0.001
#define EPSILON 1e-15 // Kerbl et al. (2023)

inline void update(real g, real rate, real root_correction, __global real *parameter,
                   __global real *m, __global real *v)
{
    const real new_m = *m + (real)ONE_MINUS_BETA1 * (g - *m);
    const real new_v = *v + (real)ONE_MINUS_BETA2 * (g * g - *v);
    *m = new_m;
    *v = new_v;
    *parameter -= rate * new_m / (sqrt(new_v) / root_correction + (real)EPSILON);
}

// rows: uint[V], the row of each gradient; NO_ROW is skipped.
__kernel void adam_rows(uint count, uint stride, uint used, real rate, real root_correction,
                        __global const uint *restrict rows, __global const real *restrict gradient,
                        __global real *restrict parameter, __global real *restrict m,
                        __global real *restrict v)
{
    const uint i = get_global_id(0), own = i / used, column = i % used;
    if (own >= count || rows[own] == NO_ROW)
        return;
    const ulong at = (ulong)rows[own] * stride + column;
    update(gradient[(ulong)own * stride + column], rate, root_correction, parameter + at, m + at,
           v + at);
}

// Every row: places: uint[N], the gradient's row of each parameter row, NO_ROW where it is zero.
__kernel void adam_all(uint count, uint stride, uint used, real rate, real root_correction,
                       __global const uint *restrict places, __global const real *restrict gradient,
                       __global real *restrict parameter, __global real *restrict m,
                       __global real *restrict v)
{
    const uint i = get_global_id(0), own = i / used, column = i % used;
    if (own >= count)
        return;
    const ulong at = (ulong)own * stride + column;
    const real g =
        places[own] == NO_ROW ? 0 : gradient[(ulong)places[own] * stride + column];
    update(g, rate, root_correction, parameter + at, m + at, v + at);
}

// places[rows[i]] = i; places holds NO_ROW elsewhere.
__kernel void invert_rows(uint count, __global const uint *restrict rows,
                          __global uint *restrict places)
{
    const uint i = get_global_id(0);
    if (i < count && rows[i] != NO_ROW)
        places[rows[i]] = i;
}
