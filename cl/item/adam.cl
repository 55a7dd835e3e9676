// Item form of adam.cl (see there): a work-item walks rows, up to 16 columns at a time.
#include "prefetch.h"
#include "rows.h"
DEFINE_MOVES(3)
DEFINE_MOVES(4)
DEFINE_MOVES(16)
DEFINE_CODES(3)
DEFINE_CODES(4)
DEFINE_CODES(16)

// NAME neighbouring columns at once, by the vector type of S; none is one. `element` is the number
// of the first of them among all columns of the rows, and IOTA_S counts them.
#define DEFINE_UPDATE(NAME, S, LOAD, STORE, IOTA_S)                                                \
    inline void keep_##NAME(real##S first, real##S second, uint element, uint now,                 \
                            __global FIRST_MOMENT *m, __global SECOND_MOMENT *v)                   \
    {                                                                                              \
        const uint##S noise = noise_of##S(element + IOTA_S, now);                                  \
        STORE(first_code##S(first, second, noise), 0, m);                                          \
        STORE(second_code##S(second, noise), 0, v);                                                \
    }                                                                                              \
    inline void step_##NAME(real##S g, real rate, real correction, __global real *parameter,       \
                            uint element, uint now, __global FIRST_MOMENT *m,                      \
                            __global SECOND_MOMENT *v)                                             \
    {                                                                                              \
        real##S first = m_of##S(LOAD(0, m)), second = v_of##S(LOAD(0, m), LOAD(0, v));             \
        STORE(stepped##S(LOAD(0, parameter), g, rate, correction, &first, &second), 0, parameter); \
        keep_##NAME(first, second, element, now, m, v);                                            \
    }                                                                                              \
    inline void catch_up_##NAME(LazyState state, real distance, __global real *parameter,          \
                                uint element, uint now, __global FIRST_MOMENT *m,                  \
                                __global SECOND_MOMENT *v)                                         \
    {                                                                                              \
        const real##S first = m_of##S(LOAD(0, m)), second = v_of##S(LOAD(0, m), LOAD(0, v));       \
        STORE(decayed_step##S(LOAD(0, parameter), state.epsilon, distance, first, second), 0,      \
              parameter);                                                                          \
        if (state.keeps)                                                                           \
            keep_##NAME(first * state.decay1, second * state.decay2, element, now, m, v);          \
    }

DEFINE_UPDATE(1, , LOAD_ONE, STORE_ONE, 0u)
DEFINE_UPDATE(3, 3, vload3, vstore3, (uint3)(0, 1, 2))
DEFINE_UPDATE(4, 4, vload4, vstore4, (uint4)(0, 1, 2, 3))
DEFINE_UPDATE(16, 16, vload16, vstore16, convert_uint16(IOTA))

// CALL(WIDTH, LOAD) for all columns, of which the next is `column`.
#define EACH_WIDTH(CALL)                                                                           \
    uint column = 0;                                                                               \
    for (; column + 16 <= SH_COLUMNS; column += 16)                                                \
        CALL(16, vload16);                                                                         \
    for (; column + 4 <= SH_COLUMNS; column += 4)                                                  \
        CALL(4, vload4);                                                                           \
    for (; column < SH_COLUMNS; column++)                                                          \
        CALL(1, LOAD_ONE);

inline void prefetch_row(uint row, ulong rest, __global const FIRST_MOMENT *m,
                         __global const SECOND_MOMENT *v, __global const FIRST_MOMENT *m_rest,
                         __global const SECOND_MOMENT *v_rest)
{
    PREFETCH_ROW(m, row, SMALL_COLUMNS);
    PREFETCH_ROW(v, row, SMALL_COLUMNS);
#if DEGREE > 0
    PREFETCH_ROW(m_rest, rest, SH_STRIDE);
    PREFETCH_ROW(v_rest, rest, SH_STRIDE);
#endif
}
// Parameters and moments of a row.
#define PREFETCH_ALL(ROW)                                                                          \
    {                                                                                              \
        const ulong its_rest = REST_ROW(ROW);                                                      \
        prefetch_gaussian(ROW, its_rest, positions, sh_constant, sh_rest, opacity_logits,          \
                          log_scales, quaternions);                                                \
        prefetch_row(ROW, its_rest, m, v, m_rest, v_rest);                                         \
    }

// Of small columns of a row: element, step and moments.
#define OWN(COLUMN)                                                                                \
    SMALL_ELEMENT(row, COLUMN), now, m + (ulong)row * SMALL_COLUMNS + COLUMN,                      \
        v + (ulong)row * SMALL_COLUMNS + COLUMN
#define STEP(WIDTH, LOAD)                                                                          \
    step_##WIDTH(LOAD(0, g + column), rate_sh_rest, correction, sh_rest + to + column,             \
                 REST_ELEMENT(row, column), now, m_rest + to + column, v_rest + to + column)
__kernel void adam_step(ADAM_STEP_ARGUMENTS)
{
    if (counts[COUNT_FAILED])
        return;
    const uint count = counts[COUNT_VISIBLE];
    const real8 rates = (real8)(rate_positions, rate_sh_constant, rate_sh_rest, rate_opacity_logits,
                                rate_log_scales, rate_quaternions, first, first);
    FOR_EACH(i, min(work, max(count, (uint)CATCH_UP_EVERY))) {
        if (i < CATCH_UP_EVERY)
            add_terms(i, now, rates, correction, coefficients);
        if (i >= count)
            continue;
        last_step[visible[i]] = now;
        const uint soon = rows[min((uint)i + AHEAD, count - 1)];
        if (soon != NO_ROW)
            PREFETCH_ALL(soon);
        const uint row = rows[i];
        if (row == NO_ROW)
            continue;
        step_3(vload3(i, grad_positions), rate_positions, correction, positions + 3ul * row,
               OWN(SMALL_POSITION));
        step_3(share * vload3(i, grad_colours), rate_sh_constant, correction,
               sh_constant + 3ul * row, OWN(SMALL_CONSTANT));
        step_1(grad_opacity_logits[i], rate_opacity_logits, correction, opacity_logits + row,
               OWN(SMALL_OPACITY));
        step_3(vload3(i, grad_log_scales), rate_log_scales, correction, log_scales + 3ul * row,
               OWN(SMALL_SCALE));
        step_4(vload4(i, grad_quaternions), rate_quaternions, correction, quaternions + 4ul * row,
               OWN(SMALL_TURN));
#if DEGREE > 0
        real g[SH_COLUMNS];
        if (rank_one) {
            real basis[SH_SIZE];
            harmonics(vload3(i, directions), basis);
            const real3 grad_colour = vload3(i, grad_colours);
            for (uint k = 0; k < SH_ACTIVE; k++)
                vstore3(basis[k] * grad_colour, k, g);
        } else
            for (uint k = 0; k < SH_COLUMNS; k++)
                g[k] = grad_sh_rest[i * SH_STRIDE + k];
        const ulong to = REST_ROW(row) * SH_STRIDE;
        EACH_WIDTH(STEP)
#endif
    }
}

inline void catch_up_small(uint row, uint now, LazyState state, __global const real *c,
                           __global real *positions, __global real *sh_constant,
                           __global real *opacity_logits, __global real *log_scales,
                           __global real *quaternions, __global FIRST_MOMENT *m,
                           __global SECOND_MOMENT *v)
{
    catch_up_3(state, c[LAZY_POSITIONS], positions + 3ul * row, OWN(SMALL_POSITION));
    catch_up_3(state, c[LAZY_SH_CONSTANT], sh_constant + 3ul * row, OWN(SMALL_CONSTANT));
    catch_up_1(state, c[LAZY_OPACITY], opacity_logits + row, OWN(SMALL_OPACITY));
    catch_up_3(state, c[LAZY_SCALES], log_scales + 3ul * row, OWN(SMALL_SCALE));
    catch_up_4(state, c[LAZY_TURNS], quaternions + 4ul * row, OWN(SMALL_TURN));
}

#define CATCH_UP(WIDTH, LOAD)                                                                      \
    catch_up_##WIDTH(state, c[LAZY_SH_REST], sh_rest + to + column, REST_ELEMENT(row, column),     \
                     now, m_rest + to + column, v_rest + to + column)
#define LISTED 256 // rows that are tested before any of them moves, so that it can be asked for
__kernel void adam_catch_up(ADAM_CATCH_UP_ARGUMENTS)
{
    if (counts[COUNT_FAILED])
        return;
    const uint begin = (ulong)count * get_global_id(0) / get_global_size(0);
    const uint end = (ulong)count * (get_global_id(0) + 1) / get_global_size(0);
    for (uint start = begin; start < end; start += LISTED) {
        const uint stop = min(start + LISTED, end);
        uint due[LISTED], listed = 0;
        for (uint first = start; first < stop; first += 16) {
            const uint number = min(stop - first, 16u);
            int stale[16] = {0};
            real position_sums[16] = {0}, scale_sums[16] = {0};
            for (uint i = 0; i < number; i++) {
                __global const real *c =
                    coefficients + (last_step[first + i] % CATCH_UP_EVERY) * LAZY_TERMS;
                position_sums[i] = c[LAZY_POSITIONS];
                scale_sums[i] = c[LAZY_SCALES];
                stale[i] = -(HAS_REST(first + i) &&
                             is_stale(first + i, now, keeps, has_frozen, frozen, last_step));
            }
            mask16 mask = convert_mask16(vload16(0, stale));
            if (by_camera) {
                real16 x, y, z;
                load_in_camera(camera, positions + 3ul * first, number, &x, &y, &z);
                mask &= may_be_seen(camera, 0, x, y, z,
                                    load_largest(log_scales + 3ul * first, number),
                                    vload16(0, position_sums), vload16(0, scale_sums));
            }
            listed += list_rows(mask, first, number, due + listed);
        }
        for (uint i = 0; i < listed; i++) {
            const uint row = due[i], last = last_step[row];
            PREFETCH_ALL(due[min(i + AHEAD, listed - 1)]);
            const LazyState state = lazy_state(last, now, keeps, coefficients);
            __global const real *c = coefficients + (last % CATCH_UP_EVERY) * LAZY_TERMS;
            catch_up_small(row, now, state, c, positions, sh_constant, opacity_logits, log_scales,
                           quaternions, m, v);
#if DEGREE > 0
            const ulong to = REST_ROW(row) * SH_STRIDE;
            EACH_WIDTH(CATCH_UP)
#endif
            if (keeps)
                last_step[row] = now;
        }
    }
}

__kernel void adam_seen(ADAM_SEEN_ARGUMENTS)
{
    FOR_EACH(block, (count + 15) / 16) {
        const uint first = 16 * block, number = min(count - first, 16u);
        real position_sums[16] = {0}, scale_sums[16] = {0};
        for (uint i = 0; i < number; i++) {
            position_sums[i] = drift_sum(last_step[first + i], now, LAZY_POSITIONS, coefficients);
            scale_sums[i] = drift_sum(last_step[first + i], now, LAZY_SCALES, coefficients);
        }
        real16 x, y, z;
        load_in_camera(camera, positions + 3ul * first, number, &x, &y, &z);
        const mask16 seen = may_be_seen(
            camera, margin, x, y, z, load_largest(log_scales + 3ul * first, number),
            vload16(0, position_sums) + position_ahead, vload16(0, scale_sums) + scale_ahead);
        int flagged[16];
        STORE_MASK(seen, flagged);
        for (uint i = 0; i < number; i++)
            flags[first + i] = flagged[i] != 0;
    }
}
