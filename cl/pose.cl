// Small corrections of the poses of training views, learned beside the gaussians, as the poses that
// structure from motion found are wrong by a part of a pixel or more (Lin et al. 2021, BARF, learn
// poses in this way).
//
// poses: real[V, POSE_REALS], a row (turn, shift) in the axes of the given camera. `shift`, times
// `depth`, moves the camera's centre: c' = c + depth R^T shift. `turn` is a rotation vector that
// turns what the camera sees about that centre: R' = E R with E = exp([turn]x), so that
// p' = E (p - depth shift). Both are angles of the same size at a point at that depth.
//
// The gradient comes from pose_terms of project_adjoint, by a turn of p' and by the positions.
// partials: real[blocks, POSE_REALS], sums over POSE_BLOCK gaussians each: blocks of a fixed size,
// as in exposure.cl.
#include "real.h"
#include "each.h"
#include "camera.h"
#include "counts.h"
#include "adam_row.h"

#if FORM_ITEM
#include "item/pose.cl"
#else
#include "group/pose.cl"
#endif

// By which E = 1 + x [turn]x + y [turn]x^2, and the derivative of E by turn, a turn from the left,
// 1 + y [turn]x + z [turn]x^2 (Rodrigues' formula and its left Jacobian). Static, as
// clang leaves it a function, which in C99 is nowhere without that.
static inline real3 turn_factors(real3 turn)
{
    const real angle = length(turn), half_angle = angle / 2;
    const real sinc = half_angle > 0 ? sin(half_angle) / half_angle : 1;
    // angle - sin(angle) cancels: for small angles its series
    const real square = angle * angle;
    const real z = square < (real)0.01
                       ? (1 - square / 20 * (1 - square / 42 * (1 - square / 72))) / 6
                       : (angle - sin(angle)) / (square * angle);
    return (real3)(sinc * cos(half_angle), sinc * sinc / 2, z);
}

inline real3 turned(real3 turn, real3 factors, real3 v)
{
    const real3 once = cross(turn, v);
    return v + factors.x * once + factors.y * cross(turn, once);
}

// The packed camera of a view with its corrected pose. One work-item.
__kernel void pose_apply(uint view, real depth, __global const real *restrict camera,
                         __global const real *restrict poses, __global real *restrict corrected)
{
    if (get_global_id(0) > 0)
        return;
    const real3 turn = vload3(2 * view, poses);
    const real3 shift = depth * vload3(2 * view + 1, poses), factors = turn_factors(turn);
    __global const real *w = camera + CAMERA_ROTATION;
    for (int k = 0; k < CAMERA_REALS; k++)
        corrected[k] = camera[k];
    for (int k = 0; k < 3; k++) {
        const real3 column = turned(turn, factors, (real3)(w[k], w[3 + k], w[6 + k]));
        corrected[CAMERA_ROTATION + k] = column.x;
        corrected[CAMERA_ROTATION + 3 + k] = column.y;
        corrected[CAMERA_ROTATION + 6 + k] = column.z;
    }
    vstore3(turned(turn, factors, vload3(0, camera + CAMERA_TRANSLATION) - shift), 0,
            corrected + CAMERA_TRANSLATION);
    vstore3(vload3(0, camera + CAMERA_POSITION) + to_world(camera, shift), 0,
            corrected + CAMERA_POSITION);
}

// One step on the pose of `view`, whose given camera is `camera`, as exposure_step takes one: with
// the penalty pull / 2 |pose|^2; a gradient that is not finite changes nothing and is counted. With
// a rate of 0, in the warm-up, nothing changes.
#define PARTS 16
__kernel __attribute__((reqd_work_group_size(PARTS, 1, 1)))
void pose_step(uint view, real rate, real pull, real depth, uint blocks,
               __global const uint *restrict counts, __global const real *restrict camera,
               __global const real *restrict partials, __global real *restrict poses,
               __global real *restrict m, __global real *restrict v, __global uint *restrict steps,
               __global uint *restrict skipped)
{
    __local real sums[PARTS][POSE_REALS];
    const uint part = get_local_id(0);
    real3 by_turn = (real3)(0), by_position = (real3)(0);
    for (uint block = part; block < blocks; block += PARTS) {
        by_turn += vload3(2 * block, partials);
        by_position += vload3(2 * block + 1, partials);
    }
    vstore3(by_turn, 0, sums[part]);
    vstore3(by_position, 1, sums[part]);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (part > 0 || counts[COUNT_FAILED] || !(rate > 0))
        return;
    for (int p = 1; p < PARTS; p++) {
        by_turn += vload3(0, sums[p]);
        by_position += vload3(1, sums[p]);
    }
    poses += view * POSE_REALS;
    const real3 turn = vload3(0, poses), shift = vload3(1, poses);
    const real3 factors = turn_factors(turn), once = cross(turn, by_turn);
    const real3 grad_turn =
        by_turn - factors.y * once + factors.z * cross(turn, once) + pull * turn;
    __global const real *w = camera + CAMERA_ROTATION;
    const real3 grad_shift =
        pull * shift - depth * (real3)(dot(vload3(0, w), by_position),
                                       dot(vload3(1, w), by_position),
                                       dot(vload3(2, w), by_position));
    real gradient[POSE_REALS];
    vstore3(grad_turn, 0, gradient);
    vstore3(grad_shift, 1, gradient);
    for (int k = 0; k < POSE_REALS; k++)
        if (!isfinite(gradient[k] * gradient[k])) { // an infinite v would never heal
            ++*skipped;
            return;
        }
    adam_row(gradient, POSE_REALS, ++steps[view], rate, poses, m + view * POSE_REALS,
             v + view * POSE_REALS);
}
