// Rows by index. rows: real[M, width], or bytes in builds with BYTES; one writer a slot.
#include "real.h"
#include "each.h"
#if BYTES
#define ELEMENT uchar
#else
#define ELEMENT real
#endif

// result[i, :] = rows[indices[i], :]
__kernel void gather(uint count, uint width, __global const uint *restrict indices,
                     __global const ELEMENT *restrict rows, __global ELEMENT *restrict result)
{
    FOR_EACH(i, (ulong)count * width)
        result[i] = rows[(ulong)indices[i / width] * width + i % width];
}

// result[indices[i], :] = rows[i, :], where no index comes twice
__kernel void scatter(uint count, uint width, __global const uint *restrict indices,
                      __global const ELEMENT *restrict rows, __global ELEMENT *restrict result)
{
    FOR_EACH(i, (ulong)count * width)
        result[(ulong)indices[i / width] * width + i % width] = rows[i];
}
