// The gradients of several views of one step as one, view after view: which rows were seen, and the
// sums of their gradients by row. visible: uint[V], the row of each gradient of a view, distinct;
// rows: uint[V], the same, or NO_ROW for one that nothing follows; of the V, counts[COUNT_VISIBLE]
// exist. One writer a slot.
#include "real.h"
#include "each.h"
#include "counts.h"

// flags: uint[N], 1 where a view has seen the row; keys: uint[N], there the row, or NO_ROW where
// nothing is to follow its gradient in one view or more.
__kernel void batch_mark(__global const uint *restrict counts,
                         __global const uint *restrict visible, __global const uint *restrict rows,
                         __global uint *restrict flags, __global uint *restrict keys)
{
    FOR_EACH(v, counts[COUNT_VISIBLE]) {
        const uint row = visible[v];
        const bool stays = rows[v] == NO_ROW || (flags[row] && keys[row] == NO_ROW);
        keys[row] = stays ? NO_ROW : row;
        flags[row] = 1;
    }
}

// rows[v] = keys[visible[v]], of the rows that any view has seen; their flags become 0 for the next
// batch.
__kernel void batch_rows(__global const uint *restrict counts,
                         __global const uint *restrict visible, __global const uint *restrict keys,
                         __global uint *restrict flags, __global uint *restrict rows)
{
    FOR_EACH(v, counts[COUNT_VISIBLE]) {
        rows[v] = keys[visible[v]];
        flags[visible[v]] = 0;
    }
}

// mean[v, :] = sums[visible[v], :], which becomes 0 for the next batch.
__kernel void batch_take(uint width, __global const uint *restrict counts,
                         __global const uint *restrict visible, __global real *restrict sums,
                         __global real *restrict mean)
{
    FOR_EACH(i, (ulong)counts[COUNT_VISIBLE] * width) {
        const ulong from = (ulong)visible[i / width] * width + i % width;
        mean[i] = sums[from];
        sums[from] = 0;
    }
}

#if FORM_ITEM
#include "item/batch.cl"
#else
#include "group/batch.cl"
#endif
