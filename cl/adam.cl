// One Adam step (Kingma & Ba 2015) on one field; bias corrections are folded into the arguments:
//
//   m <- m + (1 - beta1)(g - m);   v <- v + (1 - beta2)(g^2 - v)
//   parameter <- parameter - rate m / (correction sqrt(v) + epsilon)
//
// with rate = learning rate / (1 - beta1^t), correction = 1 / sqrt(1 - beta2^t). parameter, m, v:
// real[N, stride]; gradient: real[V, stride]; only the first `used` columns of a row are touched
// (harmonics not yet active stay out). Elementwise, one writer each.
//
// adam_rows: rows: uint[V], the row of each gradient; NO_ROW is skipped.
// adam_all, every row: places: uint[N], the gradient's row of each parameter row, NO_ROW where it is
// zero; STAYS where row and moments are to stay, for the gradient was not finite or the row is frozen.
#include "real.h"
#include "each.h"
#include "counts.h"
#include "vector.h"
#define STAYS (NO_ROW - 1)

// `count` neighbouring elements at once; TYPE is real or a vector of it.
#define DEFINE_UPDATE(NAME, TYPE, LOAD, STORE)                                                     \
    inline void NAME(TYPE g, real rate, real correction, __global real *parameter,                 \
                     __global real *m, __global real *v)                                           \
    {                                                                                              \
        const TYPE old_m = LOAD(0, m), old_v = LOAD(0, v);                                         \
        const TYPE new_m = old_m + (real)ONE_MINUS_BETA1 * (g - old_m);                            \
        const TYPE new_v = old_v + (real)ONE_MINUS_BETA2 * (g * g - old_v);                        \
        STORE(new_m, 0, m);                                                                        \
        STORE(new_v, 0, v);                                                                        \
        STORE(LOAD(0, parameter) - rate * new_m / (sqrt(new_v) * correction + (real)ADAM_EPSILON), \
              0, parameter);                                                                       \
    }
DEFINE_UPDATE(update1, real, LOAD_ONE, STORE_ONE)

#if FORM_ITEM
#include "item/adam.cl"
#else
#include "group/adam.cl"
#endif

// places[i] of rows that no view has seen: NO_ROW, or STAYS where frozen[i] is not 0.
__kernel void freeze_places(uint count, __global const uint *restrict frozen,
                            __global uint *restrict places)
{
    FOR_EACH(i, count)
        places[i] = frozen[i] ? STAYS : NO_ROW;
}

// places[visible[i]] = i, or STAYS where rows[i] is NO_ROW; places stays as it is elsewhere.
__kernel void invert_rows(uint count, __global const uint *restrict visible,
                          __global const uint *restrict rows, __global uint *restrict places)
{
    FOR_EACH(i, count)
        places[visible[i]] = rows[i] == NO_ROW ? STAYS : i;
}

// rows[i] becomes NO_ROW, of a gradient that nothing follows, where frozen[visible[i]] is not 0.
__kernel void freeze_rows(__global const uint *restrict counts, __global const uint *restrict visible,
                          __global const uint *restrict frozen, __global uint *restrict rows)
{
    FOR_EACH(i, counts[COUNT_VISIBLE])
        rows[i] = frozen[visible[i]] ? NO_ROW : rows[i];
}
