// Group form of batch.cl (see there): a work-item an element.

// sums[rows[v], :] += share gradient[v, :]
__kernel void batch_add(uint width, real share, __global const uint *restrict counts,
                        __global const uint *restrict rows, __global const real *restrict gradient,
                        __global real *restrict sums)
{
    FOR_EACH(i, (ulong)counts[COUNT_VISIBLE] * width) {
        const uint row = rows[i / width];
        if (row != NO_ROW)
            sums[(ulong)row * width + i % width] += share * gradient[i];
    }
}
