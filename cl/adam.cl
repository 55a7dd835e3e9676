// One Adam step (Kingma & Ba 2015) on one field; bias corrections are folded into the arguments:
//
//   m <- m + (1 - beta1)(g - m);   v <- v + (1 - beta2)(g^2 - v)
//   parameter <- parameter - rate m / (correction sqrt(v) + epsilon)
//
// with rate = learning rate / (1 - beta1^t), correction = 1 / sqrt(1 - beta2^t). parameter, m, v:
// real[N, stride]; gradient: real[V, stride]; only the first `used` columns of a row are touched
// (harmonics not yet active stay out). Elementwise, one writer each. Item form: a work-item walks
// rows, 16 columns at a time. Group form: a work-item an element.
#include "real.h"
#include "each.h"
#define NO_ROW UINT_MAX
#define STAYS (UINT_MAX - 1)
#define ONE_MINUS_BETA1 0.1 // written out: in single precision the difference loses digits
#define ONE_MINUS_BETA2 0.001
#define EPSILON 1e-15 // Kerbl et al. (2023)

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
        STORE(LOAD(0, parameter) - rate * new_m / (sqrt(new_v) * correction + (real)EPSILON), 0,   \
              parameter);                                                                          \
    }
#define LOAD_ONE(OFFSET, P) (*(P))
#define STORE_ONE(VALUE, OFFSET, P) (*(P) = (VALUE))
DEFINE_UPDATE(update1, real, LOAD_ONE, STORE_ONE)
DEFINE_UPDATE(update4, real4, vload4, vstore4)
DEFINE_UPDATE(update16, real16, vload16, vstore16)

// Columns [begin, end) of the row of gradients at `from` and of the parameters at `to`; without a
// gradient (has is false) it counts as zero.
#define UPDATE(WIDTH, TYPE, LOAD)                                                                  \
    for (; column + WIDTH <= end; column += WIDTH)                                                 \
        update##WIDTH(has ? LOAD(0, from + column) : (TYPE)(0), rate, correction,                  \
                      parameter + to + column, m + to + column, v + to + column);
inline void update_columns(uint begin, uint end, bool has, __global const real *from, ulong to,
                           real rate, real correction, __global real *parameter, __global real *m,
                           __global real *v)
{
    uint column = begin;
#if FORM_ITEM
    UPDATE(16, real16, vload16)
    UPDATE(4, real4, vload4)
#endif
    UPDATE(1, real, LOAD_ONE)
}

// A work-item's share of a row: all of it (item form), or one column.
#if FORM_ITEM
#define OWN_ELEMENTS(count, used) (count)
#define OWN_ROW(i, used) (i)
#define OWN_COLUMNS(i, used) 0, used
#else
#define OWN_ELEMENTS(count, used) ((ulong)(count) * (used))
#define OWN_ROW(i, used) ((i) / (used))
#define OWN_COLUMNS(i, used) (uint)((i) % (used)), (uint)((i) % (used)) + 1
#endif

// rows: uint[V], the row of each gradient; NO_ROW is skipped.
__kernel void adam_rows(uint count, uint stride, uint used, real rate, real correction,
                        __global const uint *restrict rows, __global const real *restrict gradient,
                        __global real *restrict parameter, __global real *restrict m,
                        __global real *restrict v)
{
    FOR_EACH(i, OWN_ELEMENTS(count, used)) {
        const ulong own = OWN_ROW(i, used);
        if (rows[own] != NO_ROW)
            update_columns(OWN_COLUMNS(i, used), true, gradient + own * stride,
                           (ulong)rows[own] * stride, rate, correction, parameter, m, v);
    }
}

// Every row: places: uint[N], the gradient's row of each parameter row, NO_ROW where it is zero;
// STAYS where row and moments are to stay, for the gradient was not finite or the row is held.
__kernel void adam_all(uint count, uint stride, uint used, real rate, real correction,
                       __global const uint *restrict places, __global const real *restrict gradient,
                       __global real *restrict parameter, __global real *restrict m,
                       __global real *restrict v)
{
    FOR_EACH(i, OWN_ELEMENTS(count, used)) {
        const ulong own = OWN_ROW(i, used);
        const uint place = places[own];
        const bool has = place != NO_ROW;
        if (place != STAYS)
            update_columns(OWN_COLUMNS(i, used), has, gradient + (has ? (ulong)place * stride : 0),
                           own * stride, rate, correction, parameter, m, v);
    }
}

// places[i] of rows that no view has seen: NO_ROW, or STAYS where held[i] is not 0.
__kernel void hold_places(uint count, __global const uint *restrict held,
                          __global uint *restrict places)
{
    FOR_EACH(i, count)
        places[i] = held[i] ? STAYS : NO_ROW;
}

// places[visible[i]] = i, or STAYS where rows[i] is NO_ROW; places stays as it is elsewhere.
__kernel void invert_rows(uint count, __global const uint *restrict visible,
                          __global const uint *restrict rows, __global uint *restrict places)
{
    FOR_EACH(i, count)
        places[visible[i]] = rows[i] == NO_ROW ? STAYS : i;
}

// rows[i] becomes NO_ROW, of a gradient that nothing follows, where held[visible[i]] is not 0.
__kernel void hold_rows(uint count, __global const uint *restrict visible,
                        __global const uint *restrict held, __global uint *restrict rows)
{
    FOR_EACH(i, count)
        rows[i] = held[visible[i]] ? NO_ROW : rows[i];
}
