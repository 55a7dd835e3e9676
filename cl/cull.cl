// Which gaussians a camera sees: those whose footprint at its cutoff meets the image.
//
// flags: uint[N], 1 for those that are seen; totals: uint[chunks], how many of each chunk of rows
// are. compact.cl lists them. One writer a slot: deterministic.
#include "real.h"
#include "chunk.h"
#include "projection.h"

inline bool meets_image(__global const real *camera, real2 mean, real2 extent)
{
    const real2 size = vload2(0, camera + CAMERA_SIZE);
    return mean.x + extent.x > 0 && mean.y + extent.y > 0 && mean.x - extent.x < size.x &&
           mean.y - extent.y < size.y;
}

// At least the footprint's extent, from the largest scale alone: most gaussians are outside the
// image, and this says so without their rotation. The rows of J W have length focal/z sqrt(1 +
// r^2).
inline real2 largest_extent(__global const real *camera, real3 p, real3 log_scale)
{
    const real scale = exp(max(log_scale.x, max(log_scale.y, log_scale.z)));
    const real2 ratio = clamped_ratio(camera, p);
    const real2 reach = vload2(0, camera + CAMERA_FOCAL) / divisor_of(p) * scale;
    const real cutoff = 2.003 * log((real)ALPHA_STEPS); // of an opacity of 1, and a hair more
    return sqrt(cutoff * (reach * reach * (1 + ratio * ratio) + camera[CAMERA_LOW_PASS]));
}

CHUNK_KERNEL
void cull(uint count, uint chunk, __global const real *restrict camera,
          __global const real *restrict positions, __global const real *restrict log_scales,
          __global const real *restrict quaternions, __global const real *restrict opacity_logits,
          __global uint *restrict flags, __global uint *restrict totals)
{
    CHUNK_SCRATCH
    const uint begin = CHUNK_INDEX * chunk, end = min(begin + chunk, count);
    uint seen = 0;
    FOR_CHUNK(row, begin, end) {
        bool flag = false;
        const real3 p = to_camera(camera, vload3(row, positions));
        const real2 mean = mean_pixel(camera, p);
        if (p.z > camera[CAMERA_NEAR] &&
            meets_image(camera, mean, largest_extent(camera, p, vload3(row, log_scales)))) {
            const Footprint f =
                footprint_of(row, camera, positions, log_scales, quaternions, opacity_logits);
            real cutoff;
            real2 extent;
            flag = drawable(f, &cutoff, &extent) && meets_image(camera, mean, extent);
        }
        flags[row] = flag;
        seen += flag;
    }
    const uint total = CHUNK_TOTAL(seen);
    if (CHUNK_LEADS)
        totals[CHUNK_INDEX] = total;
}
