// Rows by index: result[i, :] = rows[indices[i], :]. rows: real[M, width]; one writer a slot.
#include "real.h"

__kernel void gather(uint count, uint width, __global const uint *restrict indices,
                     __global const real *restrict rows, __global real *restrict result)
{
    const ulong i = get_global_id(0);
    if (i >= (ulong)count * width)
        return;
    result[i] = rows[(ulong)indices[i / width] * width + i % width];
}

// Keep rows whose flag is set: their numbers and their keys, in order. offsets: scan of flags.
__kernel void compact(uint count, __global const uint *restrict flags,
                      __global const uint *restrict offsets, __global const uint *restrict keys,
                      __global uint *restrict kept_keys, __global uint *restrict kept)
{
    const uint i = get_global_id(0);
    if (i >= count || !flags[i])
        return;
    kept_keys[offsets[i]] = keys[i];
    kept[offsets[i]] = i;
}

// The inverse: rows[indices[i], :] = values[i, :]; indices must be distinct.
__kernel void scatter(uint count, uint width, __global const uint *restrict indices,
                      __global const real *restrict values, __global real *restrict rows)
{
    const ulong i = get_global_id(0);
    if (i >= (ulong)count * width)
        return;
    rows[(ulong)indices[i / width] * width + i % width] = values[i];
}
