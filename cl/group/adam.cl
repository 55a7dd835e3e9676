// Group form of adam.cl (see there). A work-group takes a few rows: first a work-item looks at each
// and lists those to be moved, in any order, as rows are apart; then all work-items go over their
// columns, so that neighbours touch neighbouring columns. The rows of a group are few, as a small
// model has too few to fill a GPU with one a work-item; and of several elements a work-item loads
// all before it stores any, as it mostly waits for memory. Work-groups have at most MOST_ITEMS
// work-items.
#define MOST_ITEMS 256
#define SHARE_OF(items, spread) (((items) + (spread) - 1) / (spread)) // rows of a group
#define SMALL_AT_ONCE 2 // elements that a work-item loads before it stores any
#define REST_AT_ONCE 3

// Of five values, or arrays, that of the field of a small column.
#define OF_FIELD(column, position, constant, opacity, scale, turn)                                 \
    ((column) < SMALL_CONSTANT  ? (position)                                                       \
     : (column) < SMALL_OPACITY ? (constant)                                                       \
     : (column) < SMALL_SCALE   ? (opacity)                                                        \
     : (column) < SMALL_TURN    ? (scale)                                                          \
                                : (turn))

// Where a small column of a row is in the array of its field.
inline ulong place_in_field(ulong row, uint column)
{
    return row * OF_FIELD(column, 3u, 3u, 1u, 3u, 4u) + column -
           OF_FIELD(column, SMALL_POSITION, SMALL_CONSTANT, SMALL_OPACITY, SMALL_SCALE, SMALL_TURN);
}

// An element of a list of elements; past its end the work-item's first one again, whose loads are
// harmless.
inline uint element_at(uint first, uint later, uint elements)
{
    return first + later < elements ? first + later : first;
}

__kernel void adam_step(ADAM_STEP_ARGUMENTS)
{
    if (counts[COUNT_FAILED])
        return;
    const real8 rates = (real8)(rate_positions, rate_sh_constant, rate_sh_rest, rate_opacity_logits,
                                rate_log_scales, rate_quaternions, first, first);
    FOR_EACH(i, CATCH_UP_EVERY)
        add_terms(i, now, rates, correction, coefficients);
    __local uint live, live_rows[SHARE_OF(MOST_ITEMS, STEP_SPREAD)];
    __local uint live_places[SHARE_OF(MOST_ITEMS, STEP_SPREAD)];
    // harmonics and colour gradient of a row
    __local real shared[SHARE_OF(MOST_ITEMS, STEP_SPREAD) * (SH_ACTIVE + 3)];
    const uint count = min(work, counts[COUNT_VISIBLE]);
    const uint lane = get_local_id(0), size = get_local_size(0);
    const uint part = SHARE_OF(size, STEP_SPREAD);
    for (ulong begin = get_group_id(0) * (ulong)part; begin < count;
         begin += get_num_groups(0) * (ulong)part) {
        uint listed = NO_ROW;
        if (lane < part && begin + lane < count) {
            listed = rows[begin + lane];
            last_step[visible[begin + lane]] = now;
        }
        if (lane == 0)
            live = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (listed != NO_ROW) {
            const uint place = atomic_inc(&live);
            live_rows[place] = listed;
            live_places[place] = lane;
#if DEGREE > 0
            if (rank_one) {
                real basis[SH_SIZE];
                harmonics(vload3(begin + lane, directions), basis);
                __local real *own = shared + place * (SH_ACTIVE + 3);
                for (uint k = 0; k < SH_ACTIVE; k++)
                    own[k] = basis[k];
                vstore3(vload3(begin + lane, grad_colours), 0, own + SH_ACTIVE);
            }
#endif
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        const uint elements = live * SMALL_COLUMNS;
        for (uint base = 0; base < elements; base += SMALL_AT_ONCE * size) {
            const uint i = base + lane;
            if (i >= elements)
                continue;
            uint row[SMALL_AT_ONCE], column[SMALL_AT_ONCE];
            real parameter[SMALL_AT_ONCE], g[SMALL_AT_ONCE], own_m[SMALL_AT_ONCE],
                own_v[SMALL_AT_ONCE];
#pragma unroll
            for (uint k = 0; k < SMALL_AT_ONCE; k++) {
                const uint element = element_at(i, k * size, elements);
                const uint place = element / SMALL_COLUMNS;
                row[k] = live_rows[place];
                column[k] = element % SMALL_COLUMNS;
                const ulong moments = (ulong)row[k] * SMALL_COLUMNS + column[k];
                g[k] = OF_FIELD(column[k], grad_positions, grad_colours, grad_opacity_logits,
                                grad_log_scales, grad_quaternions)[place_in_field(
                    begin + live_places[place], column[k])];
                parameter[k] = OF_FIELD(column[k], positions, sh_constant, opacity_logits,
                                        log_scales, quaternions)[place_in_field(row[k], column[k])];
                own_m[k] = m_of(m[moments]);
                own_v[k] = v_of(m[moments], v[moments]);
            }
#pragma unroll
            for (uint k = 0; k < SMALL_AT_ONCE; k++) {
                if (i + k * size >= elements)
                    continue;
                const ulong moments = (ulong)row[k] * SMALL_COLUMNS + column[k];
                const real rate = OF_FIELD(column[k], rate_positions, rate_sh_constant,
                                           rate_opacity_logits, rate_log_scales, rate_quaternions);
                OF_FIELD(column[k], positions, sh_constant, opacity_logits, log_scales,
                         quaternions)[place_in_field(row[k], column[k])] =
                    stepped(parameter[k], OF_FIELD(column[k], 1, share, 1, 1, 1) * g[k], rate,
                            correction, own_m + k, own_v + k);
                const uint noise = noise_of(SMALL_ELEMENT(row[k], column[k]), now);
                m[moments] = first_code(own_m[k], own_v[k], noise);
                v[moments] = second_code(own_v[k], noise);
            }
        }
#if DEGREE > 0
        const uint others = live * SH_COLUMNS;
        for (uint base = 0; base < others; base += REST_AT_ONCE * size) {
            const uint i = base + lane;
            if (i >= others)
                continue;
            uint row[REST_AT_ONCE], column[REST_AT_ONCE];
            real parameter[REST_AT_ONCE], g[REST_AT_ONCE], own_m[REST_AT_ONCE],
                own_v[REST_AT_ONCE];
#pragma unroll
            for (uint k = 0; k < REST_AT_ONCE; k++) {
                const uint element = element_at(i, k * size, others);
                const uint place = element / SH_COLUMNS;
                row[k] = live_rows[place];
                column[k] = element % SH_COLUMNS;
                const ulong at = REST_ROW(row[k]) * SH_STRIDE + column[k];
                __local const real *own = shared + place * (SH_ACTIVE + 3);
                parameter[k] = sh_rest[at];
                own_m[k] = m_of(m_rest[at]);
                own_v[k] = v_of(m_rest[at], v_rest[at]);
                g[k] = rank_one
                           ? own[column[k] / 3] * own[SH_ACTIVE + column[k] % 3]
                           : grad_sh_rest[(begin + live_places[place]) * SH_STRIDE + column[k]];
            }
#pragma unroll
            for (uint k = 0; k < REST_AT_ONCE; k++) {
                if (i + k * size >= others)
                    continue;
                const ulong at = REST_ROW(row[k]) * SH_STRIDE + column[k];
                sh_rest[at] =
                    stepped(parameter[k], g[k], rate_sh_rest, correction, own_m + k, own_v + k);
                const uint noise = noise_of(REST_ELEMENT(row[k], column[k]), now);
                m_rest[at] = first_code(own_m[k], own_v[k], noise);
                v_rest[at] = second_code(own_v[k], noise);
            }
        }
#endif
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}

enum { // columns of the state of a due row: C of the fields in the order of LAZY_..., and
    DUE_DECAY1 = LAZY_C, DUE_DECAY2, DUE_EPSILON, DUE_TERMS
};

__kernel void adam_catch_up(ADAM_CATCH_UP_ARGUMENTS)
{
    if (counts[COUNT_FAILED])
        return;
    __local uint due, due_rows[SHARE_OF(MOST_ITEMS, CATCH_UP_SPREAD)];
    __local real due_states[SHARE_OF(MOST_ITEMS, CATCH_UP_SPREAD) * DUE_TERMS];
    const uint lane = get_local_id(0), size = get_local_size(0);
    const uint part = SHARE_OF(size, CATCH_UP_SPREAD);
    for (ulong begin = get_group_id(0) * (ulong)part; begin < count;
         begin += get_num_groups(0) * (ulong)part) {
        if (lane == 0)
            due = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        const ulong tested = begin + lane;
        bool is_due = lane < part && tested < count && HAS_REST(tested) &&
                      is_stale(tested, now, keeps, has_frozen, frozen, last_step);
        if (is_due && by_camera) {
            const real3 p = to_camera(camera, vload3(tested, positions));
            const real3 scales = vload3(tested, log_scales);
            __global const real *c =
                coefficients + (last_step[tested] % CATCH_UP_EVERY) * LAZY_TERMS;
            is_due = may_be_seen(camera, 0, p.x, p.y, p.z, max(scales.x, max(scales.y, scales.z)),
                                 c[LAZY_POSITIONS], c[LAZY_SCALES]);
        }
        if (is_due) {
            const uint last = last_step[tested], place = atomic_inc(&due);
            const LazyState state = lazy_state(last, now, keeps, coefficients);
            __local real *own = due_states + place * DUE_TERMS;
            for (uint k = 0; k < LAZY_C; k++)
                own[k] = coefficients[(last % CATCH_UP_EVERY) * LAZY_TERMS + k];
            own[DUE_DECAY1] = state.decay1;
            own[DUE_DECAY2] = state.decay2;
            own[DUE_EPSILON] = state.epsilon;
            due_rows[place] = tested;
            if (keeps)
                last_step[tested] = now;
        }
        // what was looked at is about to move
        barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
        const uint elements = due * SMALL_COLUMNS;
        for (uint base = 0; base < elements; base += SMALL_AT_ONCE * size) {
            const uint i = base + lane;
            if (i >= elements)
                continue;
            uint place[SMALL_AT_ONCE], column[SMALL_AT_ONCE];
            real parameter[SMALL_AT_ONCE], first[SMALL_AT_ONCE], second[SMALL_AT_ONCE];
#pragma unroll
            for (uint k = 0; k < SMALL_AT_ONCE; k++) {
                const uint element = element_at(i, k * size, elements);
                place[k] = element / SMALL_COLUMNS;
                column[k] = element % SMALL_COLUMNS;
                const uint row = due_rows[place[k]];
                const ulong moments = (ulong)row * SMALL_COLUMNS + column[k];
                parameter[k] = OF_FIELD(column[k], positions, sh_constant, opacity_logits,
                                        log_scales, quaternions)[place_in_field(row, column[k])];
                first[k] = m_of(m[moments]);
                second[k] = v_of(m[moments], v[moments]);
            }
#pragma unroll
            for (uint k = 0; k < SMALL_AT_ONCE; k++) {
                if (i + k * size >= elements)
                    continue;
                const uint row = due_rows[place[k]];
                const ulong moments = (ulong)row * SMALL_COLUMNS + column[k];
                __local const real *own = due_states + place[k] * DUE_TERMS;
                const real distance = own[OF_FIELD(column[k], LAZY_POSITIONS, LAZY_SH_CONSTANT,
                                                   LAZY_OPACITY, LAZY_SCALES, LAZY_TURNS)];
                OF_FIELD(column[k], positions, sh_constant, opacity_logits, log_scales,
                         quaternions)[place_in_field(row, column[k])] =
                    decayed_step(parameter[k], own[DUE_EPSILON], distance, first[k], second[k]);
                if (keeps) {
                    const uint noise = noise_of(SMALL_ELEMENT(row, column[k]), now);
                    const real decayed = second[k] * own[DUE_DECAY2];
                    m[moments] = first_code(first[k] * own[DUE_DECAY1], decayed, noise);
                    v[moments] = second_code(decayed, noise);
                }
            }
        }
#if DEGREE > 0
        const uint others = due * SH_COLUMNS;
        for (uint base = 0; base < others; base += REST_AT_ONCE * size) {
            const uint i = base + lane;
            if (i >= others)
                continue;
            uint place[REST_AT_ONCE], column[REST_AT_ONCE];
            real parameter[REST_AT_ONCE], first[REST_AT_ONCE], second[REST_AT_ONCE];
#pragma unroll
            for (uint k = 0; k < REST_AT_ONCE; k++) {
                const uint element = element_at(i, k * size, others);
                place[k] = element / SH_COLUMNS;
                column[k] = element % SH_COLUMNS;
                const uint row = due_rows[place[k]];
                const ulong at = REST_ROW(row) * SH_STRIDE + column[k];
                parameter[k] = sh_rest[at];
                first[k] = m_of(m_rest[at]);
                second[k] = v_of(m_rest[at], v_rest[at]);
            }
#pragma unroll
            for (uint k = 0; k < REST_AT_ONCE; k++) {
                if (i + k * size >= others)
                    continue;
                const uint row = due_rows[place[k]];
                const ulong at = REST_ROW(row) * SH_STRIDE + column[k];
                __local const real *own = due_states + place[k] * DUE_TERMS;
                sh_rest[at] = decayed_step(
                    parameter[k], own[DUE_EPSILON], own[LAZY_SH_REST], first[k], second[k]);
                if (keeps) {
                    const uint noise = noise_of(REST_ELEMENT(row, column[k]), now);
                    const real decayed = second[k] * own[DUE_DECAY2];
                    m_rest[at] = first_code(first[k] * own[DUE_DECAY1], decayed, noise);
                    v_rest[at] = second_code(decayed, noise);
                }
            }
        }
#endif
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}

__kernel void adam_seen(ADAM_SEEN_ARGUMENTS)
{
    FOR_EACH(row, count) {
        const uint last = last_step[row];
        const real3 p = to_camera(camera, vload3(row, positions));
        const real3 scales = vload3(row, log_scales);
        flags[row] =
            may_be_seen(camera, margin, p.x, p.y, p.z, max(scales.x, max(scales.y, scales.z)),
                        drift_sum(last, now, LAZY_POSITIONS, coefficients) + position_ahead,
                        drift_sum(last, now, LAZY_SCALES, coefficients) + scale_ahead) != 0;
    }
}
