// Densification regularisation: a view's pixels, moved by their rendered depth, against the photo
// of an adjacent view (SIG, "Densification Regularization"):
//
//   value = sum over valid pixels |M c(s(z)) + m - photo|^2 / their number,  z = depth / (1 - T)
//
// s(z) = (z a + e).xy / (z a + e).z, a = H (x, y, 1), is where pixel (x, y) at depth z lies in the
// neighbour, c the bilinear sample there; pixel centres are at whole numbers here. A pixel is valid
// if it is covered, T < 1/2; if z is positive and z a.z + e.z, the depth in the neighbour, above
// NEAREST z, which bounds z ds/dz to some tens of image sizes; if all four texels of the sample
// exist; and if what comes of it is finite. Others count nothing and have no gradient.
//
// A photo with a fourth plane (`masked`, `neighbour_masked`) has pixels that do not count, where
// that is 0: they are not valid, nor are samples of them.
//
// geometries: real[P, GEOMETRY_REALS], rows H row-major and e; colours: real[P, TRANSFORM_REALS],
// rows of [M | m]; `pair` says which row; photo: uchar[3, H, W]; neighbour: uchar[3, H2, W2];
// partials: real[H, 2], a row's sum of squares and number.
#include "real.h"
#include "each.h"
#define COVERED 0.5
#define NEAREST 0.1
#define BYTE ((real)(1.0 / 255))

// |colour difference|^2 and 1 of one pixel and the gradients by its depth and T, or zeros.
inline real2 reproject_pixel(int x, int y, int width, int height, int neighbour_width,
                             int neighbour_height, int masked, int neighbour_masked, real depth,
                             real transmittance, __global const uchar *restrict photo,
                             __global const uchar *restrict neighbour,
                             __global const real *restrict geometry,
                             __global const real *restrict colour, real2 *grads)
{
    *grads = (real2)(0);
    const real cover = 1 - transmittance, z = depth / cover;
    const real3 p = (real3)(x, y, 1), e = vload3(3, geometry);
    const real3 a = (real3)(dot(vload3(0, geometry), p), dot(vload3(1, geometry), p),
                            dot(vload3(2, geometry), p));
    const real3 q = z * a + e;
    const real2 s = q.xy / q.z;
    if (!(cover > (real)COVERED && z > 0 && q.z > (real)NEAREST * z && s.x >= 0 && s.y >= 0 &&
          s.x < neighbour_width - 1 && s.y < neighbour_height - 1)) // not so for a nan
        return (real2)(0);

    // of s by z; a.xy e.z - e.xy a.z rather than (a.xy - s a.z) q.z: exactly zero without a
    // baseline
    const real2 slope = (a.xy * e.z - e.xy * a.z) / q.z / q.z;
    const real2 corner = floor(s), f = s - corner;
    const long texel = (long)corner.y * neighbour_width + (long)corner.x;
    const long size = (long)neighbour_width * neighbour_height;
    const long pixel = (long)y * width + x, plane = (long)width * height;
    if (masked && !photo[3 * plane + pixel])
        return (real2)(0);
    if (neighbour_masked) {
        __global const uchar *at = neighbour + 3 * size + texel;
        if (!(at[0] && at[1] && at[neighbour_width] && at[neighbour_width + 1]))
            return (real2)(0);
    }
    real sample[3], sample_by_z[3]; // of 255: whole numbers keep equal colours exactly equal
    for (int channel = 0; channel < 3; channel++) {
        __global const uchar *at = neighbour + channel * size + texel;
        const real c00 = at[0], c10 = at[1];
        const real c01 = at[neighbour_width], c11 = at[neighbour_width + 1];
        const real top = c00 + f.x * (c10 - c00), bottom = c01 + f.x * (c11 - c01);
        const real by_x = c10 - c00 + f.y * (c11 - c01 - (c10 - c00)), by_y = bottom - top;
        sample[channel] = top + f.y * (bottom - top);
        sample_by_z[channel] = by_x * slope.x + by_y * slope.y;
    }
    const real3 seen = vload3(0, sample), seen_by_z = vload3(0, sample_by_z);
    real square = 0, grad_z = 0;
    for (int channel = 0; channel < 3; channel++) {
        const real4 row = vload4(channel, colour);
        const real difference =
            (dot(row.xyz, seen) - photo[channel * plane + pixel]) * BYTE + row.w;
        square += difference * difference;
        grad_z += difference * dot(row.xyz, seen_by_z);
    }
    const real grad_depth = grad_z * (2 * BYTE) / cover, grad_transmittance = grad_depth * z;
    if (!isfinite(square) || !isfinite(grad_depth) || !isfinite(grad_transmittance))
        return (real2)(0);
    *grads = (real2)(grad_depth, grad_transmittance);
    return (real2)(square, 1);
}

#define NAME reproject
#define ARGUMENTS                                                                                  \
    int width, int height, int neighbour_width, int neighbour_height, int masked,                  \
    int neighbour_masked,                                                                          \
    __global const real *restrict depth, __global const real *restrict transmittance,              \
    __global const uchar *restrict photo, __global const uchar *restrict neighbour,                \
    __global const real *restrict geometries, __global const real *restrict colours, uint pair
#define PIXEL                                                                                      \
    reproject_pixel(x, row, width, height, neighbour_width, neighbour_height, masked,              \
                    neighbour_masked, depth[pixel], transmittance[pixel], photo, neighbour,        \
                    geometries + GEOMETRY_REALS * (ulong)pair,                                     \
                    colours + TRANSFORM_REALS * (ulong)pair, &grads)
#include "depth_rows.h"

// The gradients of the sum of squares to those of weight times its mean, in place.
__kernel void scale_gradients(uint count, real weight, __global const real *restrict sums,
                              __global real *restrict grad_depth,
                              __global real *restrict grad_transmittance)
{
    const real scale = weight / max(sums[1], (real)1);
    FOR_EACH(i, count) {
        grad_depth[i] *= scale;
        grad_transmittance[i] *= scale;
    }
}
