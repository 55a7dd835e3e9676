// Rows by index, the inverse, and the rows a flag keeps. rows: real[M, width]; one writer a slot.
#include "real.h"
#include "each.h"

// result[i, :] = rows[indices[i], :]
__kernel void gather(uint count, uint width, __global const uint *restrict indices,
                     __global const real *restrict rows, __global real *restrict result)
{
    FOR_EACH(i, (ulong)count * width)
        result[i] = rows[(ulong)indices[i / width] * width + i % width];
}

// rows[indices[i], :] = values[i, :]; indices must be distinct.
__kernel void scatter(uint count, uint width, __global const uint *restrict indices,
                      __global const real *restrict values, __global real *restrict rows)
{
    FOR_EACH(i, (ulong)count * width)
        rows[(ulong)indices[i / width] * width + i % width] = values[i];
}

// Rows whose flag is set: their numbers and their keys, in order. offsets: scan of flags.
__kernel void compact(uint count, __global const uint *restrict flags,
                      __global const uint *restrict offsets, __global const uint *restrict keys,
                      __global uint *restrict kept_keys, __global uint *restrict kept)
{
    FOR_EACH(i, count) {
        if (flags[i]) {
            kept_keys[offsets[i]] = keys[i];
            kept[offsets[i]] = i;
        }
    }
}
