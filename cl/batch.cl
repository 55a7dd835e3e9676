// The gradients of several views of one step as one, view after view: which rows were seen, and the
// sums of their gradients by row. visible: uint[V], the row of each gradient of a view, distinct;
// rows: uint[V], the same, or NO_ROW for one that nothing follows. One writer a slot.
#include "real.h"
#include "each.h"

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

#if FORM_ITEM
#include "item/batch.cl"
#else
#include "group/batch.cl"
#endif
