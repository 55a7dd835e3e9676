// Item form of adam.cl (see there): a work-item walks rows, up to 16 columns at a time.
DEFINE_UPDATE(moment1, , moment, LOAD_ONE, STORE_ONE, LOAD_MOMENTS(1), STORE_MOMENTS(1))
DEFINE_UPDATE(moment4, 4, moment, vload4, vstore4, LOAD_MOMENTS(4), STORE_MOMENTS(4))
DEFINE_UPDATE(moment16, 16, moment, vload16, vstore16, LOAD_MOMENTS(16), STORE_MOMENTS(16))

// CALL(WIDTH, LOAD) for all columns, of which the next is `column`.
#define EACH_WIDTH(CALL)                                                                           \
    uint column = 0;                                                                               \
    for (; column + 16 <= SH_COLUMNS; column += 16)                                                \
        CALL(16, vload16);                                                                         \
    for (; column + 4 <= SH_COLUMNS; column += 4)                                                  \
        CALL(4, vload4);                                                                           \
    for (; column < SH_COLUMNS; column++)                                                          \
        CALL(1, LOAD_ONE);

#define STEP(WIDTH, LOAD)                                                                          \
    step_moment##WIDTH(LOAD(0, g + column), rate, correction, rounding_seed(row, column, now),    \
                       sh_rest + to + column, m + moments + column, v + moments + column)
__kernel void adam_harmonics(uint now, uint rank_one, real rate, real correction,
                             __global const uint *restrict counts,
                             __global const uint *restrict rows,
                             __global const real *restrict grad_colours,
                             __global const real *restrict directions,
                             __global const real *restrict gradient, __global real *restrict sh_rest,
                             __global moment *restrict m, __global moment *restrict v)
{
#if DEGREE > 0
    const uint count = counts[COUNT_VISIBLE];
    FOR_EACH(i, count) {
        const uint row = rows[i];
        if (row == NO_ROW)
            continue;
        real g[SH_COLUMNS];
        if (rank_one) {
            real basis[SH_SIZE];
            harmonics(vload3(i, directions), basis);
            const real3 grad_colour = vload3(i, grad_colours);
            for (uint k = 0; k < SH_ACTIVE; k++)
                vstore3(basis[k] * grad_colour, k, g);
        } else
            for (uint column = 0; column < SH_COLUMNS; column++)
                g[column] = gradient[i * SH_STRIDE + column];
        const ulong to = (ulong)row * SH_STRIDE, moments = (ulong)row * MOMENT_STRIDE;
        EACH_WIDTH(STEP)
    }
#endif
}

#define COAST(WIDTH, LOAD)                                                                         \
    coast_moment##WIDTH(lag, c[LAG_SH_REST], rounding_seed(row, column, now),                     \
                        sh_rest + to + column, m_rest + moments + column,                          \
                        v_rest + moments + column)
__kernel void adam_catch_up(
    uint count, uint now, uint keeps, uint has_frozen, uint by_camera,
    __global const uint *restrict counts,
    __global const real *restrict camera, __global const uint *restrict frozen,
    __global const real *restrict coefficients, __global real *restrict positions,
    __global real *restrict sh_constant, __global real *restrict sh_rest,
    __global real *restrict opacity_logits, __global real *restrict log_scales,
    __global real *restrict quaternions, __global real *restrict m, __global real *restrict v,
    __global moment *restrict m_rest, __global moment *restrict v_rest,
    __global uint *restrict last_step)
{
    if (counts[COUNT_FAILED])
        return;
    FOR_EACH(row, count) {
        if (!is_due(row, now, keeps, has_frozen, by_camera, camera, frozen, positions, log_scales,
                    coefficients, last_step))
            continue;
        const uint last = last_step[row];
        const Lag lag = lag_of(last, now, keeps, coefficients);
        __global const real *c = coefficients + (last % CATCH_UP_EVERY) * LAG_TERMS;
        coast_small(row, lag, c, positions, sh_constant, opacity_logits, log_scales, quaternions, m,
                    v);
#if DEGREE > 0
        const ulong to = row * SH_STRIDE, moments = row * MOMENT_STRIDE;
        EACH_WIDTH(COAST)
#endif
        if (keeps)
            last_step[row] = now;
    }
}
