// Item form of batch.cl (see there): a work-item walks rows.

// sums[rows[v], :] += share gradient[v, :]
__kernel void batch_add(uint width, real share, __global const uint *restrict counts,
                        __global const uint *restrict rows, __global const real *restrict gradient,
                        __global real *restrict sums)
{
    FOR_EACH(v, counts[COUNT_VISIBLE]) {
        if (rows[v] != NO_ROW)
            for (uint column = 0; column < width; column++)
                sums[(ulong)rows[v] * width + column] += share * gradient[v * width + column];
    }
}
