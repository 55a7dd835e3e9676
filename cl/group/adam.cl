// Group form of adam.cl (see there). A work-item takes the small columns of a row; the harmonics of
// the group's rows are then spread over its work-items, so that neighbours touch neighbouring
// columns. Work-groups have at most MOST_ITEMS work-items.
#define MOST_ITEMS 256
DEFINE_UPDATE(moment1, , moment, LOAD_ONE, STORE_ONE, LOAD_MOMENTS(1), STORE_MOMENTS(1))

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
    __local real shared[MOST_ITEMS * (SH_ACTIVE + 3)]; // harmonics and colour gradient of a row
    __local uint shared_rows[MOST_ITEMS];
    const uint lane = get_local_id(0), size = get_local_size(0);
    for (ulong begin = get_group_id(0) * (ulong)size; begin < count;
         begin += get_num_groups(0) * (ulong)size) {
        const uint own_rows = min((ulong)size, count - begin);
        if (lane < own_rows) {
            shared_rows[lane] = rows[begin + lane];
            if (rank_one) {
                real basis[SH_SIZE];
                harmonics(vload3(begin + lane, directions), basis);
                __local real *own = shared + lane * (SH_ACTIVE + 3);
                for (uint k = 0; k < SH_ACTIVE; k++)
                    own[k] = basis[k];
                vstore3(vload3(begin + lane, grad_colours), 0, own + SH_ACTIVE);
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint i = lane; i < own_rows * SH_COLUMNS; i += size) {
            const uint place = i / SH_COLUMNS, column = i % SH_COLUMNS, row = shared_rows[place];
            if (row == NO_ROW)
                continue;
            __local const real *own = shared + place * (SH_ACTIVE + 3);
            const real g = rank_one ? own[column / 3] * own[SH_ACTIVE + column % 3]
                                    : gradient[(begin + place) * SH_STRIDE + column];
            const ulong moments = (ulong)row * MOMENT_STRIDE + column;
            step_moment1(g, rate, correction, rounding_seed(row, column, now),
                         sh_rest + (ulong)row * SH_STRIDE + column, m + moments, v + moments);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
#endif
}

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
    __local uint due, due_rows[MOST_ITEMS]; // in any order: rows are apart
    __local real due_lags[4 * MOST_ITEMS];
    const uint lane = get_local_id(0), size = get_local_size(0);
    for (ulong begin = get_group_id(0) * (ulong)size; begin < count;
         begin += get_num_groups(0) * (ulong)size) {
        if (lane == 0)
            due = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        const ulong row = begin + lane;
        if (row < count && is_due(row, now, keeps, has_frozen, by_camera, camera, frozen, positions,
                                  log_scales, coefficients, last_step)) {
            const uint last = last_step[row], place = atomic_inc(&due);
            __global const real *c = coefficients + (last % CATCH_UP_EVERY) * LAG_TERMS;
            const Lag lag = lag_of(last, now, keeps, coefficients);
            due_rows[place] = row;
            vstore4((real4)(lag.decay1, lag.decay2, lag.epsilon, c[LAG_SH_REST]), place, due_lags);
            coast_small(row, lag, c, positions, sh_constant, opacity_logits, log_scales, quaternions,
                        m, v);
            if (keeps)
                last_step[row] = now;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
#if DEGREE > 0
        const uint elements = due * SH_COLUMNS;
        for (uint i = lane; i < elements; i += size) {
            const uint place = i / SH_COLUMNS, column = i % SH_COLUMNS, own = due_rows[place];
            const real4 shared = vload4(place, due_lags);
            const Lag lag = {shared.x, shared.y, shared.z, keeps};
            const ulong moments = (ulong)own * MOMENT_STRIDE + column;
            coast_moment1(lag, shared.w, rounding_seed(own, column, now),
                          sh_rest + (ulong)own * SH_STRIDE + column, m_rest + moments,
                          v_rest + moments);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
#endif
    }
}
