// The gradients of several views of one step as one, view after view: which rows were seen, and the
// sums of their gradients by row. visible: uint[V], the row of each gradient of a view, distinct;
// rows: uint[V], the same, or NO_ROW for one that nothing follows. One writer a slot.
#include "real.h"
#include "each.h"
#define NO_ROW UINT_MAX

// flags: uint[N], 1 where a view has seen the row; keys: uint[N], there the row, or NO_ROW where
// nothing is to follow its gradient in one view or more.
__kernel void batch_mark(uint count, __global const uint *restrict visible,
                         __global const uint *restrict rows, __global uint *restrict flags,
                         __global uint *restrict keys)
{
    FOR_EACH(v, count) {
        const uint row = visible[v];
        const bool stays = rows[v] == NO_ROW || (flags[row] && keys[row] == NO_ROW);
        keys[row] = stays ? NO_ROW : row;
        flags[row] = 1;
    }
}

// sums[rows[v], :] += share gradient[v, :]. Item form: a work-item walks rows. Group form: elements.
__kernel void batch_add(uint count, uint width, real share, __global const uint *restrict rows,
                        __global const real *restrict gradient, __global real *restrict sums)
{
#if FORM_ITEM
    FOR_EACH(v, count) {
        if (rows[v] != NO_ROW)
            for (uint column = 0; column < width; column++)
                sums[(ulong)rows[v] * width + column] += share * gradient[v * width + column];
    }
#else
    FOR_EACH(i, (ulong)count * width) {
        const uint row = rows[i / width];
        if (row != NO_ROW)
            sums[(ulong)row * width + i % width] += share * gradient[i];
    }
#endif
}
