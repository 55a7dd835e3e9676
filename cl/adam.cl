// Adam (Kingma & Ba 2015), bias corrections folded into the arguments:
//
//   m <- m + (1 - beta1)(g - m);   v <- v + (1 - beta2)(g^2 - v)
//   parameter <- parameter - rate m / (correction sqrt(v) + epsilon)
//
// with rate = learning rate / (1 - beta1^t), correction = 1 / sqrt(1 - beta2^t).
//
// adam_step moves the rows that have a gradient: the 14 small columns of all fields but the
// harmonics (m, v: [N, 14], in the order of SMALL_...), and the active harmonics (m_rest, v_rest:
// [N, SH_STRIDE]); moments.h says how moments are stored. rows: uint[V], the row of each gradient;
// NO_ROW is skipped: row and moments stay for this step. Elementwise, one writer each. Nothing
// moves once a frame has failed.
//
// Dense Adam moves all other rows as well, with g = 0. Nobody reads them, so adam_catch_up does it
// later, for all steps after last_step[row] at once. Without gradients m and v only decay, so that
// the sum over the steps k after t0 has the moments of step t0 as a factor:
//
//   sum of rate_k m_k / (correction_k sqrt(v_k) + epsilon) = m C / (sqrt(v) + epsilon D / C),
//   C = sum of rate_k / correction_k (beta1 / sqrt(beta2))^(k - t0),
//   D = sum of rate_k / correction_k^2 (beta1 / beta2)^(k - t0)
//
// but for a relative error of at most s (x / (1 + x))^2, x the mean of epsilon / (correction_k
// sqrt(v_k)) over the sum and s its relative variance, 0.13 at t0 = 3, 3e-4 at 300, 3e-5 at 3000:
// with x = 1e-15 / 1e-12 that is below 1e-6, and gradients are rarely smaller. adam_step adds its
// step to the sums: coefficients: real[CATCH_UP_EVERY, LAZY_TERMS], row t0 % CATCH_UP_EVERY: C of
// each field, and C and D of a rate of 1. Every CATCH_UP_EVERY steps all rows catch up.
#include "real.h"
#include "each.h"
#include "camera.h"
#include "harmonics.h"
#include "vector.h"
#include "counts.h"
#include "moments.h"
#include "rest.h"
#define SH_STRIDE (3 * SH_REST)
#define SH_COLUMNS (3 * SH_ACTIVE)
enum {
    SMALL_POSITION = 0, SMALL_CONSTANT = 3, SMALL_OPACITY = 6, SMALL_SCALE = 7, SMALL_TURN = 10
};
typedef char every_column_has_a_moment[SMALL_TURN + 4 == SMALL_COLUMNS ? 1 : -1];
// The number of a column of a row among all, for noise_of; it may begin anew.
#define SMALL_ELEMENT(ROW, COLUMN) ((ROW) * (SMALL_COLUMNS + SH_STRIDE) + (COLUMN))
#define REST_ELEMENT(ROW, COLUMN) SMALL_ELEMENT(ROW, SMALL_COLUMNS + (COLUMN))
enum { // columns of coefficients: C of the fields in their order
    LAZY_POSITIONS, LAZY_SH_CONSTANT, LAZY_SH_REST, LAZY_OPACITY, LAZY_SCALES, LAZY_TURNS,
    LAZY_C, // of a rate of 1
    LAZY_D
};
typedef char every_term_has_a_column[LAZY_D + 1 == LAZY_TERMS ? 1 : -1];

// What a row has missed: by what its moments decay, and epsilon D / C. keeps: whether the moments
// are stored, too.
typedef struct {
    real decay1, decay2, epsilon;
    bool keeps;
} LazyState;

// The parameter after a step, and after steps without a gradient, of `S` columns at once; none is
// one. *first and *second are the moments, which a step changes.
#define DEFINE_MOVES(S)                                                                            \
    inline real##S stepped##S(real##S parameter, real##S g, real rate, real correction,            \
                              real##S *first, real##S *second)                                     \
    {                                                                                              \
        *first += (real)ONE_MINUS_BETA1 * (g - *first);                                            \
        *second += (real)ONE_MINUS_BETA2 * (g * g - *second);                                      \
        return parameter - rate * *first / (sqrt(*second) * correction + (real)ADAM_EPSILON);      \
    }                                                                                              \
    inline real##S decayed_step##S(real##S parameter, real epsilon, real distance, real##S first,  \
                              real##S second)                                                      \
    {                                                                                              \
        return parameter - distance * first / (sqrt(second) + epsilon);                            \
    }
DEFINE_MOVES()

// Add a step to row i of the sums of C and D. rates: of the fields in the order of LAZY_...,
// divided by 1 - beta1^t, and twice 1 / (1 - beta1^t).
inline void add_terms(uint i, uint now, real8 rates, real correction,
                      __global real *restrict coefficients)
{
    const uint begun = (now - 1) / CATCH_UP_EVERY * CATCH_UP_EVERY + i; // t0 of this row
    if (begun >= now)
        return;
    const real missed = now - begun;
    const real c = exp(missed * (real)(LOG_BETA1 - LOG_BETA2 / 2)) / correction;
    const real d = exp(missed * (real)(LOG_BETA1 - LOG_BETA2)) / (correction * correction);
    const real8 terms = rates * (real8)(c, c, c, c, c, c, c, d);
    vstore8((begun + 1 < now ? vload8(i, coefficients) : (real8)(0)) + terms, i, coefficients);
}

// |m| / sqrt(v) of whatever gradients, at most (1 - beta1) / sqrt((1 - beta2)(1 - beta1^2 / beta2))
// by Cauchy and Schwarz, 7.27, and a hair more; times C it bounds how far a column may drift. A
// coded v has been rounded many times, and may be a half of it: four standard deviations, as
// measured.
#if CODED
#define MAX_MOMENTUM_RATIO 10.5
#else
#define MAX_MOMENTUM_RATIO 7.4
#endif

#define MOST_CUTOFF 11.1 // 2 ln(ALPHA_STEPS), of an opacity of 1, and a hair more
typedef char the_cutoff_is_high_enough[ALPHA_STEPS <= 255 ? 1 : -1];

// Whether the image may show a stale row: at least what cull (cull.cl) finds once the row
// has caught up, from its stale position in the camera's frame, its stale logarithm of its largest
// scale, and the sums C of positions and scales, which bound how far these may drift. `margin`,
// pixels, are added to the image on every side, and as many per cent to the near plane. A vreal at
// a time.
inline vmask may_be_seen(__global const real *camera, real margin, vreal x, vreal y, vreal z,
                         vreal log_scale, vreal position_sum, vreal scale_sum)
{
    __global const real *focal = camera + CAMERA_FOCAL, *centre = camera + CAMERA_CENTRE;
    __global const real *size = camera + CAMERA_SIZE, *ratios = camera + CAMERA_RATIOS;
    const real near = camera[CAMERA_NEAR], low_pass = camera[CAMERA_LOW_PASS];
    const vreal max_drift = (real)(1.7321 * MAX_MOMENTUM_RATIO) * position_sum;
    const vreal nearest = z - max_drift;
    const vreal place_x = x * (1 / z), place_y = y * (1 / z);
    const vreal closeness_x = focal[0] * (1 / nearest), closeness_y = focal[1] * (1 / nearest);
    const real ratio_x = fmax(fabs(ratios[0]), fabs(ratios[2]));
    const real ratio_y = fmax(fabs(ratios[1]), fabs(ratios[3]));
    const vreal scale = exp(log_scale + (real)MAX_MOMENTUM_RATIO * scale_sum);
    const vreal reach_x = closeness_x * scale, reach_y = closeness_y * scale;
    const vreal extent_x =
        sqrt((real)MOST_CUTOFF * (reach_x * reach_x * (1 + ratio_x * ratio_x) + low_pass)) +
        closeness_x * max_drift * (1 + fabs(place_x)) + margin;
    const vreal extent_y =
        sqrt((real)MOST_CUTOFF * (reach_y * reach_y * (1 + ratio_y * ratio_y) + low_pass)) +
        closeness_y * max_drift * (1 + fabs(place_y)) + margin;
    const vreal mean_x = focal[0] * place_x + centre[0], mean_y = focal[1] * place_y + centre[1];
    const vmask inside = TO_MASK(mean_x + extent_x > 0) & TO_MASK(mean_y + extent_y > 0) &
                         TO_MASK(mean_x - extent_x < size[0]) &
                         TO_MASK(mean_y - extent_y < size[1]);
    return TO_MASK(z + max_drift > near / (1 + margin / 100)) &
           (TO_MASK(nearest <= near * (1 + margin / 100)) | inside);
}

// The sum C of a field by which a row that is not frozen may have drifted.
inline real drift_sum(uint last, uint now, uint field, __global const real *coefficients)
{
    return last == now ? 0 : coefficients[(last % CATCH_UP_EVERY) * LAZY_TERMS + field];
}

// Whether a row is stale. A frozen one stays, and has missed nothing.
inline bool is_stale(uint row, uint now, bool keeps, bool has_frozen, __global const uint *frozen,
                 __global uint *last_step)
{
    if (last_step[row] == now)
        return false;
    if (!has_frozen || !frozen[row])
        return true;
    if (keeps)
        last_step[row] = now;
    return false;
}

inline LazyState lazy_state(uint last, uint now, bool keeps, __global const real *coefficients)
{
    __global const real *c = coefficients + (last % CATCH_UP_EVERY) * LAZY_TERMS;
    const real missed = now - last;
    LazyState state;
    state.decay1 = exp(missed * (real)LOG_BETA1);
    state.decay2 = exp(missed * (real)LOG_BETA2);
    state.epsilon = (real)ADAM_EPSILON * (c[LAZY_D] / c[LAZY_C]);
    state.keeps = keeps;
    return state;
}

// adam_step adds its terms of the sums of C and D even for a view that sees nothing: the launch is
// of work elements, at least CATCH_UP_EVERY. grad_colours times share are the gradients of
// sh_constant. Those of the harmonics are their values in `directions` times grad_colours where
// rank_one, else grad_sh_rest. rates are divided by 1 - beta1^t, and first = 1 / (1 - beta1^t); now
// is the number of the step, t.
#define ADAM_STEP_ARGUMENTS                                                                        \
    uint work, uint now, uint rank_one, real first, real correction, real share,                   \
    real rate_positions, real rate_sh_constant, real rate_sh_rest, real rate_opacity_logits,       \
    real rate_log_scales, real rate_quaternions, __global const uint *restrict counts,             \
    __global const uint *restrict visible, __global const uint *restrict rows,                     \
    __global const real *restrict grad_positions, __global const real *restrict grad_colours,      \
    __global const real *restrict grad_opacity_logits,                                             \
    __global const real *restrict grad_log_scales,                                                 \
    __global const real *restrict grad_quaternions, __global const real *restrict directions,      \
    __global const real *restrict grad_sh_rest, PARAMETERS_AND_MOMENTS,                            \
    __global uint *restrict last_step, __global real *restrict coefficients REST_ARGUMENTS
#define ADAM_CATCH_UP_ARGUMENTS                                                                    \
    uint count, uint now, uint keeps, uint has_frozen, uint by_camera,                             \
    __global const uint *restrict counts, __global const real *restrict camera,                    \
    __global const uint *restrict frozen, __global const real *restrict coefficients,              \
    PARAMETERS_AND_MOMENTS, __global uint *restrict last_step REST_ARGUMENTS
// flags: uint[N], 1 for rows that the image may show, and pixels `margin` beside it, once it has
// drifted by more sums C: position_ahead, scale_ahead.
#define ADAM_SEEN_ARGUMENTS                                                                        \
    uint count, uint now, real margin, real position_ahead, real scale_ahead,                      \
    __global const real *restrict camera,                                                          \
    __global const real *restrict coefficients, __global const real *restrict positions,           \
    __global const real *restrict log_scales, __global const uint *restrict last_step,             \
    __global uint *restrict flags
#define PARAMETERS_AND_MOMENTS                                                                     \
    __global real *restrict positions, __global real *restrict sh_constant,                        \
    __global real *restrict sh_rest, __global real *restrict opacity_logits,                       \
    __global real *restrict log_scales, __global real *restrict quaternions,                       \
    __global FIRST_MOMENT *restrict m, __global SECOND_MOMENT *restrict v,                         \
    __global FIRST_MOMENT *restrict m_rest, __global SECOND_MOMENT *restrict v_rest
#if FORM_ITEM
#include "item/adam.cl"
#else
#include "group/adam.cl"
#endif

// Columns begin to end - 1 of the moments of all rows become 0.
__kernel void adam_clear(uint count, uint begin, uint end, __global FIRST_MOMENT *restrict m,
                         __global SECOND_MOMENT *restrict v)
{
    FOR_EACH(i, count) {
        for (uint column = begin; column < end; column++)
            m[i * SMALL_COLUMNS + column] = v[i * SMALL_COLUMNS + column] = 0;
    }
}
