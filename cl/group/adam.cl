// Group form of adam.cl (see there): a work-item an element.

__kernel void adam_rows(uint stride, uint used, real rate, real correction, __global const uint *restrict counts,
                        __global const uint *restrict rows, __global const real *restrict gradient,
                        __global real *restrict parameter, __global real *restrict m,
                        __global real *restrict v)
{
    FOR_EACH(i, (ulong)counts[COUNT_VISIBLE] * used) {
        const ulong own = i / used, to = (ulong)rows[own] * stride + i % used;
        if (rows[own] != NO_ROW)
            update1(gradient[own * stride + i % used], rate, correction, parameter + to, m + to,
                    v + to);
    }
}

__kernel void adam_all(uint count, uint stride, uint used, real rate, real correction,
                       __global const uint *restrict counts,
                       __global const uint *restrict places, __global const real *restrict gradient,
                       __global real *restrict parameter, __global real *restrict m,
                       __global real *restrict v)
{
    if (counts[COUNT_FAILED])
        return;
    FOR_EACH(i, (ulong)count * used) {
        const ulong own = i / used, column = i % used, to = own * stride + column;
        const uint place = places[own];
        if (place != STAYS)
            update1(place == NO_ROW ? 0 : gradient[(ulong)place * stride + column], rate, correction,
                    parameter + to, m + to, v + to);
    }
}
