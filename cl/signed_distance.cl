// Signed distances from a surface, added up view by view from rendered depths (Curless & Levoy
// 1996). A sample of the volume, at the depth z in a pixel of depth D, adds
//
//   w d,  d = min(1, (D - z) / truncation),
//
// and nothing where d < -1: what lies behind the surface is unknown. The mean over the views is
// zero on the surface and positive before it. A view counts by how sure its depth is,
//
//   w = 1 / (1 + (s / (SURE p))^2),
//
// where s is how far the depth at which half of the light is held back lies behind `first`, at
// which less of it is, and p is the size of a pixel at D. D is the middle of the two: where half of
// the light is held back lies behind the surface. A view does not count where more than half of the
// light passes, where p is more than COARSEST_PIXEL voxels, and where the four pixels between which
// D is interpolated are further apart than a truncation, as at a silhouette.
//
// The volume consists of bricks of BRICK_SIDE^3 samples, of which only those near the surface are
// there. Sample (i, j, k), k the fastest, lies at voxel (BRICK_CELLS brick + (i, j, k)): neighbours
// share a layer, to the same bytes. bricks: int[B, 3]; chosen: uint[C], the bricks that the view
// may see; depth, first, transmittance: real[H, W], of at least two pixels each way;
// image: real[3, H, W].
// sums: real[7, B, N]: of w d, of w, the number of views, the sums of red, green and blue by
// w (1 - |d|), and of that. One writer a sample.
#include "real.h"
#include "camera.h"

#define SURE 2 // pixels
#define MOST_PASSES 0.5 // of the light

// The depth D at (u, v), where the centre of pixel (0, 0) is at (0.5, 0.5); 0: none.
INLINE real depth_at(__global const real *restrict depth, __global const real *restrict first,
                     int width, int height, real u, real v, real truncation)
{
    const int x = clamp((int)floor(u - (real)0.5), 0, width - 2);
    const int y = clamp((int)floor(v - (real)0.5), 0, height - 2);
    const long above_left = (long)y * width + x, below_left = above_left + width;
    const real2 upper = (vload2(0, depth + above_left) + vload2(0, first + above_left)) / 2;
    const real2 lower = (vload2(0, depth + below_left) + vload2(0, first + below_left)) / 2;
    const real nearest = fmin(fmin(upper.x, upper.y), fmin(lower.x, lower.y));
    const real farthest = fmax(fmax(upper.x, upper.y), fmax(lower.x, lower.y));
    const real fx = clamp(u - (real)0.5 - x, (real)0, (real)1);
    const real fy = clamp(v - (real)0.5 - y, (real)0, (real)1);
    const real above = upper.x + fx * (upper.y - upper.x);
    const real below = lower.x + fx * (lower.y - lower.x);
    const real found = above + fy * (below - above);
    return farthest - nearest < truncation && isfinite(found) ? found : 0;
}

__kernel void signed_distance(uint count, uint chosen_count, int width, int height, real voxel,
                              real truncation, __global const int *restrict bricks,
                              __global const uint *restrict chosen,
                              __global const real *restrict camera,
                              __global const real *restrict depth,
                              __global const real *restrict first,
                              __global const real *restrict transmittance,
                              __global const real *restrict image, __global real *restrict sums)
{
    const ulong samples = BRICK_SIDE * BRICK_SIDE * BRICK_SIDE, item = get_global_id(0);
    if (item >= chosen_count * samples)
        return;
    const uint brick = chosen[item / samples], sample = item % samples;
    const int3 place = vload3(brick, bricks) * BRICK_CELLS
        + (int3)(sample / (BRICK_SIDE * BRICK_SIDE), sample / BRICK_SIDE % BRICK_SIDE,
                 sample % BRICK_SIDE);
    const real3 q = to_camera(camera, voxel * convert_real3(place));
    const real2 focal = vload2(0, camera + CAMERA_FOCAL);
    const real2 centre = vload2(0, camera + CAMERA_CENTRE);
    const real u = q.x / q.z * focal.x + centre.x, v = q.y / q.z * focal.y + centre.y;
    if (!(q.z > camera[CAMERA_NEAR] && u >= 0 && v >= 0 && u < width && v < height)) // nor a nan
        return;
    const real found = depth_at(depth, first, width, height, u, v, truncation);
    const long pixel = (long)v * width + (long)u, plane = (long)width * height;
    const real d = fmin((found - q.z) / truncation, (real)1), size = found / focal.x;
    const real unsure = (depth[pixel] - first[pixel]) / (SURE * size);
    const real weight = 1 / (1 + unsure * unsure), near = weight * (1 - fabs(d));
    if (!(found > 0 && d >= -1 && size <= COARSEST_PIXEL * voxel && weight > 0
          && transmittance[pixel] <= (real)MOST_PASSES))
        return;
    __global real *sum = sums + brick * samples + sample;
    const ulong step = count * samples;
    sum[0] += weight * d;
    sum[step] += weight;
    sum[2 * step] += 1;
    for (int channel = 0; channel < 3; channel++)
        sum[(3 + channel) * step] += near * image[channel * plane + pixel];
    sum[6 * step] += near;
}
