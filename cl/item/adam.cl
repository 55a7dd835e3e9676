// Item form of adam.cl (see there): a work-item walks rows, up to 16 columns at a time.
DEFINE_UPDATE(update4, real4, vload4, vstore4)
DEFINE_UPDATE(update16, real16, vload16, vstore16)

// The row of gradients at `from` and of the parameters at `to`; without a gradient (has is false) it
// counts as zero.
#define UPDATE(WIDTH, TYPE, LOAD)                                                                  \
    for (; column + WIDTH <= used; column += WIDTH)                                                \
        update##WIDTH(has ? LOAD(0, from + column) : (TYPE)(0), rate, correction,                  \
                      parameter + to + column, m + to + column, v + to + column);
inline void update_row(uint used, bool has, __global const real *from, ulong to, real rate,
                       real correction, __global real *parameter, __global real *m,
                       __global real *v)
{
    uint column = 0;
    UPDATE(16, real16, vload16)
    UPDATE(4, real4, vload4)
    UPDATE(1, real, LOAD_ONE)
}

__kernel void adam_rows(uint stride, uint used, real rate, real correction, __global const uint *restrict counts,
                        __global const uint *restrict rows, __global const real *restrict gradient,
                        __global real *restrict parameter, __global real *restrict m,
                        __global real *restrict v)
{
    FOR_EACH(i, counts[COUNT_VISIBLE]) {
        if (rows[i] != NO_ROW)
            update_row(used, true, gradient + i * stride, (ulong)rows[i] * stride, rate, correction,
                       parameter, m, v);
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
    FOR_EACH(i, count) {
        const uint place = places[i];
        const bool has = place != NO_ROW;
        if (place != STAYS)
            update_row(used, has, gradient + (has ? (ulong)place * stride : 0), i * stride, rate,
                       correction, parameter, m, v);
    }
}
