// Gaussians to splats, and the adjoint. One work-item a gaussian; elementwise, hence deterministic.
//
// The mathematics of the footprint is in projection.h. For the adjoint, with K = (M M^T + e I)^-1,
// K B = [e b1 + (S^2 b2) x (b1 x b2); e b2 + (b1 x b2) x (S^2 b1)] / det.
//
// Parameters are real[N, ...] rows; splats real[V, SPLAT_REALS] and all gradients real[V, ...] are
// rows of visible gaussians; rows[v], ascending, is the gaussian of splat v.
//
// A build with the choices of the adjoint, of which WITH_FROZEN is one, has its kernels alone, and
// one without them the others: either takes about half as long to compile as all.
#include "real.h"
#include "each.h"
#include "projection.h"
#include "harmonics.h"
#include "counts.h"
#include "rest.h"

#ifndef MASKED
#define MASKED 0
#endif
#ifndef WITH_POSE
#define WITH_POSE 0
#endif
#ifndef WITH_FEATURES
#define WITH_FEATURES 0
#endif
// Arguments that some builds lack, each after a comma.
#if WITH_FEATURES
#define FEATURES_ARGUMENT , __global real *restrict grad_features
#else
#define FEATURES_ARGUMENT
#endif
#if WITH_FROZEN
#define FROZEN_ARGUMENT , __global const uint *restrict frozen
#else
#define FROZEN_ARGUMENT
#endif
#if WITH_STATISTICS
#define STATISTICS_ARGUMENTS                                                                       \
    , __global real *restrict grad_norm_sum, __global uint *restrict seen_count
#else
#define STATISTICS_ARGUMENTS
#endif
#if MASKED
#define PHOTO_ARGUMENT , __global const uchar *restrict photo
#else
#define PHOTO_ARGUMENT
#endif
#if WITH_POSE
#define POSE_ARGUMENT , __global real *restrict pose_terms
#else
#define POSE_ARGUMENT
#endif
#ifndef CARRIED
#define CARRIED 0
#endif

// FOR_EACH_GAUSSIAN(v, count, LOADED) { body } as FOR_EACH, in a kernel that begins with
// GAUSSIANS_MEMORY. In its body HARMONIC(k) is harmonic k + 1 of the gaussian of splat v, and
// SUMS_OF(v, sum) declares the sums over its pairs.
#if FORM_ITEM
#include "item/project.cl"
#else
#include "group/project.cl"
#endif

#ifndef WITH_FROZEN
// depth_keys: uint[V], which sort splats front to back (positive floats order as their bits). A
// gaussian that `cull` saw but that cannot be drawn, as its parameters have changed since, becomes
// a splat without tiles.
__kernel void project(__global const uint *restrict counts,
                      __global const uint *restrict rows, __global const real *restrict camera,
                      __global const real *restrict positions,
                      __global const real *restrict sh_constant,
                      __global const real *restrict sh_rest,
                      __global const real *restrict opacity_logits,
                      __global const real *restrict log_scales,
                      __global const real *restrict quaternions, __global real *restrict splats,
                      __global uint *restrict depth_keys REST_ARGUMENTS)
{
    GAUSSIANS_MEMORY
    FOR_EACH_GAUSSIAN(v, counts[COUNT_VISIBLE], LOAD_HARMONICS(counts[COUNT_VISIBLE])) {
        const uint row = rows[v];
        const Footprint f =
            footprint_of(row, camera, positions, log_scales, quaternions, opacity_logits);
        __global real *splat = splats + v * SPLAT_REALS;
        real cutoff;
        real2 extent;
        if (!(drawable(f, &cutoff, &extent) && f.p.z > camera[CAMERA_NEAR])) {
            vstore4((real4)(0), 0, splat);
            vstore4((real4)(1, 0, 1, -TILE), 1, splat); // an ellipse without rows
            vstore4((real4)(0, 0, 0, camera[CAMERA_NEAR]), 2, splat);
            depth_keys[v] = 0;
            continue;
        }

        real3 colour = (real)0.5 + (real)SH_C0 * vload3(row, sh_constant);
#if DEGREE > 0
        real basis[SH_SIZE];
        const real3 d = view_direction(camera, vload3(row, positions));
        harmonics(d, basis);
#pragma unroll
        for (uint k = 0; k < SH_ACTIVE; k++)
            colour += basis[k] * HARMONIC(k);
#endif
        const real opacity = f.opacity * sqrt(f.area_ratio);
        vstore4((real4)(mean_pixel(camera, f.p), opacity, cutoff), 0, splat);
        vstore4((real4)((real3)(f.yy, -f.xy, f.xx) / f.det, extent.y), 1, splat);
        colour = select((real3)(0), colour, drawn(colour));
        vstore4((real4)(colour, f.p.z), 2, splat);
        depth_keys[v] = as_uint((float)f.p.z);
    }
}

// The sums over the pairs of each splat in a band (see `project_adjoint`), for the bands that
// follow: totals: real[V, SUMS], which may be `earlier`. A splat's pairs are emitted in the order
// of tiles, which is that of bands too: the additions are those of a frame in one piece.
__kernel void sum_pairs(__global const uint *restrict counts,
                        __global const uint *restrict splat_counts,
                        __global const uint *restrict offsets,
                        __global const real *restrict pair_grads, __global const real *earlier,
                        __global real *totals)
{
    GAUSSIANS_MEMORY
    const uint count = counts[COUNT_VISIBLE];
    FOR_EACH_GAUSSIAN(v, count, LOAD_SUMS(count)) {
        SUMS_OF(v, sum);
        for (int k = 0; k < SUMS; k++)
            totals[v * SUMS + k] = sum[k];
    }
}
#else
// From the gradients of pairs (pair_grads: real[P, SUMS], see splat.h) to those of the parameters.
// Those of a splat are the splat_counts[v] rows from offsets[v] on, and are added up in this order;
// CARRIED: to its sums over earlier bands, earlier: real[V, SUMS].
// The gradients of the harmonics are those of the colour, grad_colours, times each harmonic in the
// direction of the gaussian, directions (unit vectors; not written where DEGREE is 0): see
// harmonics_gradients.
// grad_means gets the pixel gradient of the mean. Where any gradient or the colour is not finite
// the row is left alone: active[v] is NO_ROW and `skipped` counts it. So it is, uncounted, where
// frozen[row] is not 0 (WITH_FROZEN).
//
// WITH_STATISTICS: what densification wants to know of each gaussian, summed over views: the norm
// of the screen gradient of its mean in NDC units (pixel gradient x W/2, H/2; Kerbl et al. 2023),
// and how many views saw it; a view with masked pixels (MASKED; photo: uchar[4, H, W], whose last
// plane is 0 there) did if the pixel of its mean, or the nearest of the image, counts, or if the
// gradient is not zero.
// Builds lack the arrays of choices that they do not have.
//
// WITH_FEATURES: what was blended were the features of the gaussians, not their colours, whose
// gradients are zero; grad_features: real[V, CHANNELS].
//
// WITH_POSE: pose_terms: real[V, POSE_REALS], the share of each gaussian in the gradient by the
// pose. The first three are by a small turn of all that the camera sees about its centre, camera
// axes: what moves with the mean, p x grad_p, and what turns W in M = J W R S, which is as if the
// gaussian itself had turned. The direction in which its harmonics are seen does not change in such
// a turn. The last three are the gradient by the position, world: a shift of the camera is one of
// all positions the other way. Zero where a gradient is not finite.
//
// A unit of work is done with this kernel, also one whose view sees nothing: the launch is of work
// elements, at least 1.
__kernel void project_adjoint(
    uint work, real half_width, real half_height, __global uint *restrict counts,
    __global const uint *restrict rows,
    __global const real *restrict camera, __global const real *restrict positions,
    __global const real *restrict sh_constant, __global const real *restrict sh_rest,
    __global const real *restrict opacity_logits, __global const real *restrict log_scales,
    __global const real *restrict quaternions, __global const uint *restrict splat_counts,
    __global const uint *restrict offsets, __global const real *restrict pair_grads,
    __global const real *restrict earlier, __global real *restrict grad_positions,
    __global real *restrict grad_colours, __global real *restrict directions,
    __global real *restrict grad_opacity_logits,
    __global real *restrict grad_log_scales, __global real *restrict grad_quaternions,
    __global real *restrict grad_means, __global uint *restrict active,
    __global uint *restrict skipped FROZEN_ARGUMENT STATISTICS_ARGUMENTS PHOTO_ARGUMENT
        POSE_ARGUMENT FEATURES_ARGUMENT REST_ARGUMENTS)
{
    GAUSSIANS_MEMORY
    const uint count = min(work, counts[COUNT_VISIBLE]);
    if (get_global_id(0) == 0 && !counts[COUNT_FAILED]) {
        add_long(counts + COUNT_SUM_VISIBLE, counts[COUNT_VISIBLE]);
        counts[COUNT_DONE]++;
    }
    FOR_EACH_GAUSSIAN(v, count, LOAD_HARMONICS(count) && LOAD_SUMS(count)) {
        const uint row = rows[v];
        SUMS_OF(v, sum);
        const Footprint f =
            footprint_of(row, camera, positions, log_scales, quaternions, opacity_logits);

        // power = -1/2 d^T K d with d = pixel - mean: grad_mean = K sum(grad_power d)
        const real3 conic = (real3)(f.yy, -f.xy, f.xx) / f.det;
        const real2 grad_mean = (real2)(conic.x * sum[SUM_X] + conic.y * sum[SUM_Y],
                                        conic.y * sum[SUM_X] + conic.z * sum[SUM_Y]);
        // dK = -K dC K, so grad B = 2 K G Q S^2 with Q = K B and G = 1/2 sum(grad_power d d^T). By
        // scales and by turns only Q^T G Q counts, where the long axis of a needle does not cancel
        const real e = camera[CAMERA_LOW_PASS];
        const real3 q1 = (e * f.b1 + cross(f.m2 * f.scale, f.cross_b)) / f.det;
        const real3 q2 = (e * f.b2 + cross(f.cross_b, f.m1 * f.scale)) / f.det;
        const real3 u1 = sum[SUM_XX] * q1 + sum[SUM_XY] * q2; // rows of 2 G Q
        const real3 u2 = sum[SUM_XY] * q1 + sum[SUM_YY] * q2;
        const real3 variance = f.scale * f.scale;
        real3 grad_b1 = variance * (conic.x * u1 + conic.y * u2);
        real3 grad_b2 = variance * (conic.y * u1 + conic.z * u2);
        real3 grad_log_scale = variance * (q1 * u1 + q2 * u2);
        real3 grad_turn =
            (variance.yzx - variance.zxy) * (q1.yzx * u1.zxy + q2.yzx * u2.zxy);

        real grad_opacity = sum[SUM_OPACITY];
#if ANTIALIASED
        const real root = sqrt(f.area_ratio), sharp = dot(f.cross_m, f.cross_m);
        if (f.area_ratio > AREA_RATIO_MIN) {
            const real g = grad_opacity * f.opacity * 0.5 / (root * f.det);
            const real by_sharp = 2 * g * f.blur / f.det, by_blur = -2 * g * e * (sharp / f.det);
            const real3 by_cross = by_sharp * f.cross_m * f.scale.yzx * f.scale.zxy;
            const real3 more_b1 = cross(f.b2, by_cross) + by_blur * variance * f.b1;
            const real3 more_b2 = cross(by_cross, f.b1) + by_blur * variance * f.b2;
            grad_b1 += more_b1;
            grad_b2 += more_b2;
            grad_log_scale += more_b1 * f.b1 + more_b2 * f.b2;
            grad_turn += cross(more_b1, f.b1) + cross(more_b2, f.b2);
        }
        grad_opacity *= root;
#endif
        // 1 - opacity would cancel where the opacity saturates
        const real grad_logit = grad_opacity * f.opacity / (1 + exp(opacity_logits[row]));

        const real4 grad_quaternion = turn_adjoint(f.q, f.q_length, grad_turn);
        vstore3(grad_log_scale, v, grad_log_scales);
        vstore4(grad_quaternion, v, grad_quaternions);
        vstore2(grad_mean, v, grad_means);
        grad_opacity_logits[v] = grad_logit;
        real size = fabs(grad_logit) + dot(fabs(grad_log_scale), (real3)(1)) +
                    dot(fabs(grad_quaternion), (real4)(1));

        // through A = J W to the camera-frame position
        __global const real *w = camera + CAMERA_ROTATION;
        const real3 w3 = vload3(2, w);
        const real2 focal = vload2(0, camera + CAMERA_FOCAL) / f.p.z;
        const real3 grad_a1 = (real3)(dot(f.r0, grad_b1), dot(f.r1, grad_b1), dot(f.r2, grad_b1));
        const real3 grad_a2 = (real3)(dot(f.r0, grad_b2), dot(f.r1, grad_b2), dot(f.r2, grad_b2));
        const real inverse_z = 1 / f.p.z;
        const real2 ratio = f.p.xy / f.p.z; // as clamped_ratio computes it
        const real2 along = focal * (real2)(dot(grad_a1, w3), dot(grad_a2, w3)); // by -ratio
        const real2 across =
            focal * (real2)(dot(grad_a1, vload3(0, w)), dot(grad_a2, vload3(1, w)));
        const real2 by_ratio = select((real2)(0), -along, f.ratio == ratio); // zero where clamped
        real3 grad_p;
        grad_p.xy = (by_ratio + focal * f.p.z * grad_mean) * inverse_z;
        const real2 by_z =
            across - f.ratio * along + ratio * (by_ratio + focal * f.p.z * grad_mean);
        grad_p.z = -(by_z.x + by_z.y) * inverse_z;
#if WITH_DEPTH
        grad_p.z += sum[SUM_DEPTH];
#endif
        real3 grad_position = to_world(camera, grad_p);
#if WITH_POSE
        const real3 turn_world =
            (real3)(dot(f.r0, grad_turn), dot(f.r1, grad_turn), dot(f.r2, grad_turn));
        vstore3(cross(f.p, grad_p) + (real3)(dot(vload3(0, w), turn_world),
                                             dot(vload3(1, w), turn_world), dot(w3, turn_world)),
                2 * v, pose_terms);
#endif
#if MASKED && WITH_STATISTICS
        const real2 photo_size = 2 * (real2)(half_width, half_height);
        const real2 mean = focal * f.p.xy + vload2(0, camera + CAMERA_CENTRE);
        const real2 place = fmin(fmax(mean, (real)0), photo_size - 1);
        const ulong pixel = (ulong)place.y * (ulong)photo_size.x + (ulong)place.x;
        const bool sees = photo[3 * (ulong)photo_size.x * (ulong)photo_size.y + pixel] > 0 ||
                          grad_mean.x != 0 || grad_mean.y != 0;
#else
        const bool sees = true;
#endif

#if WITH_FEATURES
        real3 grad_colour = (real3)(0);
        for (uint k = 0; k < CHANNELS; k++) {
            grad_features[v * CHANNELS + k] = sum[SUM_COLOUR + k];
            size += fabs(sum[SUM_COLOUR + k]);
        }
#else
        real3 grad_colour = vload3(0, sum + SUM_COLOUR);
#endif
        // where a colour is not drawn nothing flows
        real3 colour = (real)0.5 + (real)SH_C0 * vload3(row, sh_constant);
#if DEGREE > 0
        real basis[SH_SIZE];
        real3 h[SH_SIZE], slope_x, slope_y, slope_z;
        const real3 offset = vload3(row, positions) - vload3(0, camera + CAMERA_POSITION);
        const real inverse_distance = 1 / length(offset);
        const real3 d = offset * inverse_distance;
#pragma unroll
        for (uint k = 0; k < SH_ACTIVE; k++)
            h[k] = HARMONIC(k);
        harmonics(d, basis);
#pragma unroll
        for (uint k = 0; k < SH_ACTIVE; k++)
            colour += basis[k] * h[k];
        harmonics_slopes(d, h, &slope_x, &slope_y, &slope_z);
#endif
        grad_colour = select((real3)(0), grad_colour, drawn(colour));
#if DEGREE > 0
        const real3 g = (real3)(dot(slope_x, grad_colour), dot(slope_y, grad_colour),
                                dot(slope_z, grad_colour));
        grad_position += (g - d * dot(d, g)) * inverse_distance;
        vstore3(d, v, directions);
#endif
        vstore3(grad_position, v, grad_positions);
        vstore3(grad_colour, v, grad_colours);

        const bool finite = size + dot(fabs(grad_position) + fabs(grad_colour), (real3)(1)) <
                                (real)GRADIENT_MAX &&
                            isfinite(colour.x + colour.y + colour.z);
        if (!finite)
            atomic_inc(skipped);
#if WITH_FROZEN
        const bool moves = finite && !frozen[row];
#else
        const bool moves = finite;
#endif
        active[v] = moves ? row : NO_ROW;
#if WITH_POSE
        if (!finite)
            vstore3((real3)(0), 2 * v, pose_terms);
        vstore3(finite ? grad_position : (real3)(0), 2 * v + 1, pose_terms);
#endif
#if WITH_STATISTICS
        if (moves) {
            grad_norm_sum[row] += length(grad_mean * (real2)(half_width, half_height));
            seen_count[row] += sees;
        }
#endif
    }
}

// Gradients of the harmonics for those who need them in memory: grad_sh_constant: real[V, 3];
// grad_sh_rest: real[V, SH_REST, 3], 0 for harmonics that are not active.
__kernel void harmonics_gradients(__global const uint *restrict counts,
                                  __global const real *restrict grad_colours,
                                  __global const real *restrict directions,
                                  __global real *restrict grad_sh_constant,
                                  __global real *restrict grad_sh_rest)
{
    FOR_EACH(v, counts[COUNT_VISIBLE]) {
        const real3 grad_colour = vload3(v, grad_colours);
        vstore3((real)SH_C0 * grad_colour, v, grad_sh_constant);
#if DEGREE > 0
        real basis[SH_SIZE];
        harmonics(vload3(v, directions), basis);
        for (uint k = 0; k < SH_ACTIVE; k++)
            vstore3(basis[k] * grad_colour, v * SH_REST + k, grad_sh_rest);
#endif
        for (uint k = SH_ACTIVE; k < SH_REST; k++)
            vstore3((real3)(0), v * SH_REST + k, grad_sh_rest);
    }
}
#endif
