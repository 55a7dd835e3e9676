// Where the ray of a pixel passes the gaussian at which the light falls to a given share.
//
// A blend with a DEPTH_PERCENT leaves of each pixel the depth column of the splat at which that
// happens: that of the gaussian's centre. A surface that one large, tilted gaussian shows would
// have steps so. `number_splats` puts the number of each splat into that column before the blend,
// and `ray_depth` turns the numbers of pixels into depths: with C the covariance of a gaussian's
// projection (projection.h), k that of its depth with the two coordinates, and d from its mean to
// the pixel, the mean depth of the gaussian along the ray is z + k^T C^-1 d, as the projection is
// linearised. With the rows m of M and a row n of the same kind for the depth, k = M n, and C^-1 M
// = [e m1 + m2 x (m1 x m2); e m2 + (m1 x m2) x m1] / det, which needles do not cancel (project.cl).
#include "real.h"
#include "each.h"
#include "projection.h"

// splats: real[V, SPLAT_REALS], whose depth becomes v + 1; real holds whole numbers to 2^24.
__kernel void number_splats(uint count, __global real *restrict splats)
{
    FOR_EACH(v, count)
        splats[v * SPLAT_REALS + SPLAT_DEPTH] = v + 1;
}

// depth: real[H, W], the number of a splat, which becomes a depth, at least that of the near plane;
// 0, of a pixel without a splat, stays. rows[v] is the gaussian of splat v.
__kernel void ray_depth(int width, int height, __global const uint *restrict rows,
                        __global const real *restrict camera,
                        __global const real *restrict positions,
                        __global const real *restrict opacity_logits,
                        __global const real *restrict log_scales,
                        __global const real *restrict quaternions, __global real *restrict depth)
{
    FOR_EACH(pixel, (ulong)width * height) {
        const uint number = (uint)depth[pixel];
        if (!number)
            continue;
        const Footprint f = footprint_of(rows[number - 1], camera, positions, log_scales,
                                         quaternions, opacity_logits);
        const real e = camera[CAMERA_LOW_PASS];
        const real3 forward = vload3(2, camera + CAMERA_ROTATION);
        const real3 n = (forward.x * f.r0 + forward.y * f.r1 + forward.z * f.r2) * f.scale;
        const real2 slope = (real2)(dot(e * f.m1 + cross(f.m2, f.cross_m), n),
                                    dot(e * f.m2 + cross(f.cross_m, f.m1), n)) / f.det;
        const real2 away = (real2)(pixel % width + (real)0.5, pixel / width + (real)0.5) -
                           mean_pixel(camera, f.p);
        const real z = f.p.z + dot(slope, away);
        depth[pixel] = isfinite(z) ? fmax(z, camera[CAMERA_NEAR]) : f.p.z;
    }
}
