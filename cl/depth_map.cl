// A view's rendered depth against a depth map, such as of a laser scanner:
//
//   value = sum over pixels rho(z / d - 1) / (H W),
//   z = depth / (1 - T),  rho(e) = sqrt(e^2 + s^2) - s
//
// d is the map's depth along the camera's axis, and s = SOFTNESS: an error well below one percent
// counts by its square, and a larger one by itself, so that a few wrong depths pull no more than as
// many right ones do. A pixel counts if the map has a depth there (not 0), if it is covered, T <
// 1/2, and if its error and gradients are finite.
//
// map: real[H, W], 0 where there is none; partials: real[H, 2], a row's sum of |e| and number.
#include "real.h"
#define COVERED 0.5
#define SOFTNESS 0.01

// |e| and 1 of one pixel, and the gradients by its depth and T, or zeros.
inline real2 compare_pixel(real depth, real transmittance, real known, real weight, real2 *grads)
{
    *grads = (real2)(0);
    const real cover = 1 - transmittance, z = depth / cover;
    if (!(known > 0 && cover > (real)COVERED)) // not so for a nan
        return (real2)(0);
    const real e = z / known - 1;
    const real slope = weight * e / sqrt(e * e + (real)(SOFTNESS * SOFTNESS));
    const real grad_depth = slope / (known * cover), grad_transmittance = grad_depth * z;
    if (!isfinite(e) || !isfinite(grad_depth) || !isfinite(grad_transmittance))
        return (real2)(0);
    *grads = (real2)(grad_depth, grad_transmittance);
    return (real2)(fabs(e), 1);
}

#define NAME compare_depth
#define ARGUMENTS                                                                                  \
    int width, int height, real weight, __global const real *restrict depth,                       \
        __global const real *restrict transmittance, __global const real *restrict map
#define PIXEL                                                                                      \
    compare_pixel(depth[pixel], transmittance[pixel], map[pixel], weight / ((real)width * height), \
                  &grads)
#include "depth_rows.h"
