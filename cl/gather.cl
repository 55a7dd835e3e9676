// Rows by index. rows: real[M, width]; one writer a slot.
#include "real.h"
#include "each.h"

// result[i, :] = rows[indices[i], :]
__kernel void gather(uint count, uint width, __global const uint *restrict indices,
                     __global const real *restrict rows, __global real *restrict result)
{
    FOR_EACH(i, (ulong)count * width)
        result[i] = rows[(ulong)indices[i / width] * width + i % width];
}
