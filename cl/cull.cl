// Which gaussians a camera sees: those whose footprint at its cutoff meets the image.
//
// flags: uint[N], 1 for those that are seen; totals: uint[chunks], how many of each chunk of rows
// are. compact.cl lists them. One writer a slot: deterministic.
#include "real.h"
#include "chunk.h"
#include "projection.h"
#include "vector.h"

inline bool meets_image(__global const real *camera, real2 mean, real2 extent)
{
    const real2 size = vload2(0, camera + CAMERA_SIZE);
    return mean.x + extent.x > 0 && mean.y + extent.y > 0 && mean.x - extent.x < size.x &&
           mean.y - extent.y < size.y;
}

// Whether a gaussian may meet the image, by its mean in the camera's frame and the logarithm of its
// largest scale alone: most are outside, and this says so without their rotation. The rows of J W
// have length focal/z sqrt(1 + r^2). A vreal at a time.
inline vmask may_meet_image(__global const real *camera, vreal x, vreal y, vreal z,
                            vreal log_scale)
{
    __global const real *focal = camera + CAMERA_FOCAL, *centre = camera + CAMERA_CENTRE;
    __global const real *size = camera + CAMERA_SIZE, *ratios = camera + CAMERA_RATIOS;
    const real cutoff = 2.003 * log((real)ALPHA_STEPS); // of an opacity of 1, and a hair more
    const real low_pass = camera[CAMERA_LOW_PASS];
    const vreal inverse = 1 / (ORTHOGRAPHIC ? (vreal)1 : z), scale = exp(log_scale);
    const vreal place_x = x * inverse, place_y = y * inverse;
    const vreal reach_x = focal[0] * inverse * scale, reach_y = focal[1] * inverse * scale;
#if ORTHOGRAPHIC
    const vreal ratio_x = 0, ratio_y = 0;
#else
    const vreal ratio_x = clamp(place_x, (vreal)ratios[0], (vreal)ratios[2]);
    const vreal ratio_y = clamp(place_y, (vreal)ratios[1], (vreal)ratios[3]);
#endif
    const vreal extent_x = sqrt(cutoff * (reach_x * reach_x * (1 + ratio_x * ratio_x) + low_pass));
    const vreal extent_y = sqrt(cutoff * (reach_y * reach_y * (1 + ratio_y * ratio_y) + low_pass));
    const vreal mean_x = focal[0] * place_x + centre[0], mean_y = focal[1] * place_y + centre[1];
    return TO_MASK(z > camera[CAMERA_NEAR]) & TO_MASK(mean_x + extent_x > 0) &
           TO_MASK(mean_y + extent_y > 0) & TO_MASK(mean_x - extent_x < size[0]) &
           TO_MASK(mean_y - extent_y < size[1]);
}

// Whether the footprint of a gaussian before the camera meets the image.
inline bool footprint_meets_image(uint row, __global const real *camera,
                                  __global const real *positions, __global const real *log_scales,
                                  __global const real *quaternions,
                                  __global const real *opacity_logits)
{
    const Footprint f =
        footprint_of(row, camera, positions, log_scales, quaternions, opacity_logits);
    real cutoff;
    real2 extent;
    return drawable(f, &cutoff, &extent) && meets_image(camera, mean_pixel(camera, f.p), extent);
}

#define CULL_ARGUMENTS                                                                             \
    uint count, uint chunk, __global const real *restrict camera,                                  \
    __global const real *restrict positions, __global const real *restrict log_scales,             \
    __global const real *restrict quaternions, __global const real *restrict opacity_logits,       \
    __global uint *restrict flags, __global uint *restrict totals
#if FORM_ITEM
#include "item/cull.cl"
#else
#include "group/cull.cl"
#endif
