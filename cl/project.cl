// Gaussians to splats, and the adjoint. One work-item a gaussian; elementwise, hence deterministic.
//
// EWA splatting (Zwicker et al. 2002) with B = J W R and M = B S (2 x 3), covariance M M^T + e I,
// e the low-pass. Its determinant comes from Lagrange's identity, |m1 x m2|^2 + e(|m1|^2 + |m2|^2)
// + e^2, which keeps its digits for needles, where A C - B^2 cancels; so does m1 x m2 = (b1 x b2)
// times two scales each, and K B for the adjoint, K = (M M^T + e I)^-1:
// K B = [e b1 + (S^2 b2) x (b1 x b2); e b2 + (b1 x b2) x (S^2 b1)] / det.
//
// Parameters are real[N, ...] rows; splats real[V, SPLAT_REALS] and all gradients real[V, ...] are
// rows of visible gaussians; rows[v], ascending, is the gaussian of splat v.
#include "real.h"
#include "each.h"
#include "camera.h"
#include "quaternion.h"
#include "harmonics.h"
#include "splat.h"

#ifndef ANTIALIASED
#error "ANTIALIASED must be 0 or 1"
#endif
#define AREA_RATIO_MIN 2.5e-5 // of sharp to filtered footprint, so that its root has a gradient
#define GRADIENT_MAX 1e18 // larger counts as not finite: Adam squares it

typedef struct {
    real3 p; // camera frame
    real2 ratio; // clamped x/z, y/z
    real3 r0, r1, r2; // rotation rows of the gaussian
    real4 q;
    real q_length;
    real3 scale;
    real3 b1, b2; // rows of J W R
    real3 m1, m2; // rows of J W R S
    real3 cross_b, cross_m;
    real xx, xy, yy, det, blur; // covariance, determinant, and what the low-pass added to it
    real opacity, area_ratio;
} Footprint;

inline Footprint footprint_of(uint row, __global const real *camera, __global const real *positions,
                              __global const real *log_scales, __global const real *quaternions,
                              __global const real *opacity_logits)
{
    Footprint f;
    f.p = to_camera(camera, vload3(row, positions));
    f.ratio = clamped_ratio(camera, f.p);
    f.q = unit_quaternion(vload4(row, quaternions), &f.q_length);
    rotation_rows(f.q, &f.r0, &f.r1, &f.r2);
    f.scale = exp(vload3(row, log_scales));

    const real2 focal = vload2(0, camera + CAMERA_FOCAL) / f.p.z;
    __global const real *w = camera + CAMERA_ROTATION;
    const real3 w3 = vload3(2, w);
    const real3 a1 = focal.x * (vload3(0, w) - f.ratio.x * w3);
    const real3 a2 = focal.y * (vload3(1, w) - f.ratio.y * w3);
    f.b1 = a1.x * f.r0 + a1.y * f.r1 + a1.z * f.r2;
    f.b2 = a2.x * f.r0 + a2.y * f.r1 + a2.z * f.r2;
    f.m1 = f.b1 * f.scale;
    f.m2 = f.b2 * f.scale;

    const real e = camera[CAMERA_LOW_PASS];
    const real m11 = dot(f.m1, f.m1), m22 = dot(f.m2, f.m2);
    f.cross_b = cross(f.b1, f.b2);
    f.cross_m = f.cross_b * f.scale.yzx * f.scale.zxy;
    f.xx = m11 + e;
    f.xy = dot(f.m1, f.m2);
    f.yy = m22 + e;
    f.blur = e * (m11 + m22) + e * e;
    f.det = dot(f.cross_m, f.cross_m) + f.blur;
    f.opacity = 1 / (1 + exp(-opacity_logits[row]));
    f.area_ratio = 1;
#if ANTIALIASED
    f.area_ratio = max(dot(f.cross_m, f.cross_m) / f.det, (real)AREA_RATIO_MIN);
#endif
    return f;
}

inline real2 mean_pixel(__global const real *camera, real3 p)
{
    return vload2(0, camera + CAMERA_FOCAL) * p.xy / p.z + vload2(0, camera + CAMERA_CENTRE);
}

// Channels of a colour that are drawn; others are black and have no gradient: negative ones, and
// those so bright (or not finite) that they would overflow the gradients of all gaussians behind.
#define COLOUR_MAX 1e6
#define drawn(COLOUR) (((COLOUR) > (real3)(0)) & ((COLOUR) < (real3)(COLOUR_MAX)))

inline bool meets_image(__global const real *camera, real2 mean, real2 extent)
{
    const real2 size = vload2(0, camera + CAMERA_SIZE);
    return mean.x + extent.x > 0 && mean.y + extent.y > 0 && mean.x - extent.x < size.x &&
           mean.y - extent.y < size.y;
}

// At least the footprint's extent, from the largest scale alone: most gaussians are outside the
// image, and this says so without their rotation. The rows of J W have length focal/z sqrt(1 + r^2).
inline real2 largest_extent(__global const real *camera, real3 p, real3 log_scale)
{
    const real scale = exp(max(log_scale.x, max(log_scale.y, log_scale.z)));
    const real2 ratio = clamped_ratio(camera, p);
    const real2 reach = vload2(0, camera + CAMERA_FOCAL) / p.z * scale;
    const real cutoff = 2.003 * log((real)ALPHA_STEPS); // of an opacity of 1, and a hair more
    return sqrt(cutoff * (reach * reach * (1 + ratio * ratio) + camera[CAMERA_LOW_PASS]));
}

// Depth keys uint[N] (positive floats order as their bits) and flags uint[N]: 1 where the
// footprint at its cutoff meets the image. Comparisons are written to fail for NaN.
__kernel void cull(uint count, __global const real *restrict camera,
                   __global const real *restrict positions, __global const real *restrict log_scales,
                   __global const real *restrict quaternions,
                   __global const real *restrict opacity_logits, __global uint *restrict depth_keys,
                   __global uint *restrict flags)
{
    FOR_EACH(row, count) {
        flags[row] = 0;
        const real3 p = to_camera(camera, vload3(row, positions));
        if (!(p.z > camera[CAMERA_NEAR]))
            continue;
        const real2 mean = mean_pixel(camera, p);
        if (!meets_image(camera, mean, largest_extent(camera, p, vload3(row, log_scales))))
            continue;
        const Footprint f =
            footprint_of(row, camera, positions, log_scales, quaternions, opacity_logits);
        const real opacity = f.opacity * sqrt(f.area_ratio);
        const real cutoff = 2 * log(ALPHA_STEPS * opacity);
        const real2 extent = sqrt(cutoff * (real2)(f.xx, f.yy));
        // a footprint past the float range has no usable conic
        const bool finite = isfinite(f.det) && f.det > 0 && isfinite(extent.x) &&
                            isfinite(extent.y) && isfinite(p.z) && f.q_length > 0;
        if (cutoff > 0 && finite && meets_image(camera, mean, extent)) {
            flags[row] = 1;
            depth_keys[row] = as_uint((float)p.z);
        }
    }
}

__kernel void project(uint count, __global const uint *restrict rows,
                      __global const real *restrict camera, __global const real *restrict positions,
                      __global const real *restrict sh_constant, __global const real *restrict sh_rest,
                      __global const real *restrict opacity_logits,
                      __global const real *restrict log_scales,
                      __global const real *restrict quaternions, __global real *restrict splats)
{
    FOR_EACH(v, count) {
        const uint row = rows[v];
        const Footprint f =
            footprint_of(row, camera, positions, log_scales, quaternions, opacity_logits);
        const real opacity = f.opacity * sqrt(f.area_ratio);
        const real cutoff = 2 * log(ALPHA_STEPS * opacity);

        real3 colour = (real)0.5 + (real)SH_C0 * vload3(row, sh_constant);
#if DEGREE > 0
        real basis[SH_SIZE];
        const real3 d = normalize(vload3(row, positions) - vload3(0, camera + CAMERA_POSITION));
        harmonics(d, basis);
        for (uint k = 0; k < SH_ACTIVE; k++)
            colour += basis[k] * vload3((ulong)row * SH_REST + k, sh_rest);
#endif
        const real2 mean = mean_pixel(camera, f.p);
        __global real *splat = splats + (ulong)v * SPLAT_REALS;
        vstore4((real4)(mean, opacity, cutoff), 0, splat);
        vstore4((real4)((real3)(f.yy, -f.xy, f.xx) / f.det, sqrt(cutoff * f.yy)), 1, splat);
        colour = select((real3)(0), colour, drawn(colour));
        vstore4((real4)(colour, f.p.z), 2, splat);
    }
}

// From the pair sums of each splat (sums: real[V, S], see splat.h) to gradients of the parameters.
// The gradients of the harmonics are those of the colour, grad_colours, times each harmonic in the
// direction of the gaussian, directions (unit vectors; not written where DEGREE is 0): see
// harmonics_gradients.
// grad_means gets the pixel gradient of the mean, for densification. Where any gradient or the
// colour is not finite the row is left alone: active[v] is NO_ROW and `skipped` counts it.
__kernel void project_adjoint(
    uint count, uint sum_count, __global const uint *restrict rows,
    __global const real *restrict camera, __global const real *restrict positions,
    __global const real *restrict sh_constant, __global const real *restrict sh_rest,
    __global const real *restrict opacity_logits, __global const real *restrict log_scales,
    __global const real *restrict quaternions, __global const real *restrict sums,
    __global real *restrict grad_positions, __global real *restrict grad_colours,
    __global real *restrict directions, __global real *restrict grad_opacity_logits,
    __global real *restrict grad_log_scales, __global real *restrict grad_quaternions,
    __global real *restrict grad_means, __global uint *restrict active,
    __global uint *restrict skipped)
{
    FOR_EACH(v, count) {
        const uint row = rows[v];
        __global const real *sum = sums + (ulong)v * sum_count;
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

        // through A = J W to the camera-frame position
        __global const real *w = camera + CAMERA_ROTATION;
        const real3 w3 = vload3(2, w);
        const real2 focal = vload2(0, camera + CAMERA_FOCAL) / f.p.z;
        const real3 grad_a1 = (real3)(dot(f.r0, grad_b1), dot(f.r1, grad_b1), dot(f.r2, grad_b1));
        const real3 grad_a2 = (real3)(dot(f.r0, grad_b2), dot(f.r1, grad_b2), dot(f.r2, grad_b2));
        const real inverse_z = 1 / f.p.z;
        const real2 ratio = f.p.xy / f.p.z; // as clamped_ratio computes it
        const real2 along = focal * (real2)(dot(grad_a1, w3), dot(grad_a2, w3)); // by -ratio
        const real2 across = focal * (real2)(dot(grad_a1, vload3(0, w)), dot(grad_a2, vload3(1, w)));
        const real2 by_ratio = select((real2)(0), -along, f.ratio == ratio); // zero where clamped
        real3 grad_p;
        grad_p.xy = (by_ratio + focal * f.p.z * grad_mean) * inverse_z;
        const real2 by_z =
            across - f.ratio * along + ratio * (by_ratio + focal * f.p.z * grad_mean);
        grad_p.z = -(by_z.x + by_z.y) * inverse_z;
        if (sum_count > SUM_DEPTH)
            grad_p.z += sum[SUM_DEPTH];
        real3 grad_position = to_world(camera, grad_p);

        // colour; where it is not drawn nothing flows
        real3 grad_colour = vload3(0, sum + SUM_COLOUR);
        real3 colour = (real)0.5 + (real)SH_C0 * vload3(row, sh_constant);
#if DEGREE > 0
        real basis[SH_SIZE], weight[SH_SIZE];
        const real3 offset = vload3(row, positions) - vload3(0, camera + CAMERA_POSITION);
        const real3 d = normalize(offset);
        harmonics(d, basis);
        for (uint k = 0; k < SH_ACTIVE; k++)
            colour += basis[k] * vload3((ulong)row * SH_REST + k, sh_rest);
#endif
        grad_colour = select((real3)(0), grad_colour, drawn(colour));
#if DEGREE > 0
        for (uint k = 0; k < SH_ACTIVE; k++)
            weight[k] = dot(grad_colour, vload3((ulong)row * SH_REST + k, sh_rest));
        const real3 g = harmonics_gradient(d, weight);
        grad_position += (g - d * dot(d, g)) / length(offset);
        vstore3(d, v, directions);
#endif
        vstore3(grad_position, v, grad_positions);
        vstore3(grad_colour, v, grad_colours);
        vstore3(grad_log_scale, v, grad_log_scales);
        vstore4(grad_quaternion, v, grad_quaternions);
        vstore2(grad_mean, v, grad_means);
        grad_opacity_logits[v] = grad_logit;

        const real3 size = fabs(grad_position) + fabs(grad_colour) + fabs(grad_log_scale);
        const bool finite = size.x + size.y + size.z + fabs(grad_logit) +
                                    dot(fabs(grad_quaternion), (real4)(1)) < (real)GRADIENT_MAX &&
                            isfinite(colour.x + colour.y + colour.z);
        active[v] = finite ? row : NO_ROW;
        if (!finite)
            atomic_inc(skipped);
    }
}

// Gradients of the harmonics for those who need them in memory: grad_sh_constant: real[V, 3];
// grad_sh_rest: real[V, SH_REST, 3], 0 for harmonics that are not active.
__kernel void harmonics_gradients(uint count, __global const real *restrict grad_colours,
                                  __global const real *restrict directions,
                                  __global real *restrict grad_sh_constant,
                                  __global real *restrict grad_sh_rest)
{
    FOR_EACH(v, count) {
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
