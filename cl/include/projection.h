// A gaussian's footprint on the screen: what culling, projection and its adjoint share.
//
// EWA splatting (Zwicker et al. 2002) with B = J W R and M = B S (2 x 3), covariance M M^T + e I,
// e the low-pass. Its determinant comes from Lagrange's identity, |m1 x m2|^2 + e(|m1|^2 + |m2|^2)
// + e^2, which keeps its digits for needles, where A C - B^2 cancels; so does m1 x m2 = (b1 x b2)
// times two scales each.
#include "camera.h"
#include "quaternion.h"
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

INLINE Footprint footprint_of(uint row, __global const real *camera, __global const real *positions,
                              __global const real *log_scales, __global const real *quaternions,
                              __global const real *opacity_logits)
{
    Footprint f;
    f.p = to_camera(camera, vload3(row, positions));
    f.ratio = clamped_ratio(camera, f.p);
    f.q = unit_quaternion(vload4(row, quaternions), &f.q_length);
    rotation_rows(f.q, &f.r0, &f.r1, &f.r2);
    f.scale = exp(vload3(row, log_scales));

    const real2 focal = vload2(0, camera + CAMERA_FOCAL) / divisor_of(f.p);
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
    return vload2(0, camera + CAMERA_FOCAL) * p.xy / divisor_of(p) +
           vload2(0, camera + CAMERA_CENTRE);
}

// Channels of a colour that are drawn; others are black and have no gradient: negative ones, and
// those so bright (or not finite) that they would overflow the gradients of all gaussians behind.
#define COLOUR_MAX 1e6
#define drawn(COLOUR) (((COLOUR) > (real3)(0)) & ((COLOUR) < (real3)(COLOUR_MAX)))

// Whether a footprint can be drawn; *cutoff and *extent (pixels) get its size. One past the float
// range has no usable conic. Comparisons are written to fail for NaN.
INLINE bool drawable(Footprint f, real *cutoff, real2 *extent)
{
    *cutoff = 2 * log(ALPHA_STEPS * f.opacity * sqrt(f.area_ratio));
    *extent = sqrt(*cutoff * (real2)(f.xx, f.yy));
    return *cutoff > 0 && isfinite(f.det) && f.det > 0 && isfinite(extent->x) &&
           isfinite(extent->y) && isfinite(f.p.z) && f.q_length > 0;
}
