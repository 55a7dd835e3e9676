// Depth of the pixels of a photo by a plane sweep (Collins 1996): planes parallel to the reference
// image, at inverse depths w = first + k spacing, carry windows of the source photos onto it, and a
// pixel takes the plane whose window looks most like its own,
//
//   score = mean of the two best normalised cross-correlations over the sources,
//
// so that a source in which the place is hidden does no harm. The correlation leaves out the gain
// and the offset of brightness, which exposure changes. Windows have SIDE x SIDE pixels. The sweep
// compares every second column and row of them; then all pixels are compared on FINE planes around
// the best, half as far apart, and a parabola through the scores of three refines w.
//
// images: real[V, H, W, 2], the grey of a pixel and of the one to its right, 0 to 1; nan where a
// pixel does not count, and beyond a photo that is smaller than the others. As pairs, a sample has
// half of the reads, for which a CPU waits most. sizes: int[V, 2], (width, height). sources:
// int[S], the compared ones; warps: real[S, 12]: A (3x3, by rows) and b, with which the pixel
// (x, y) at inverse depth w lies at A (x, y, 1) + w b in the source, homogeneous.
// inverse_depths, scores: real[H, W]; both 0 where the window leaves the photo or has no texture,
// or where the best plane is the first or the last, which says that the depth lies beyond. A fine
// plane may lie up to half a spacing beyond these two.
#include "real.h"

#define SIDE 7
#define REACH 3 // pixels from the window's centre to its border
#define FINE 7 // planes
#define LEAST_VARIANCE 1e-6 // of a window with texture
#define NO_MATCH -1

// A window of the reference: every `stride`-th row and column, less the mean of them. The stride is
// a constant where these functions are called, so that compilers can unroll their loops.
// FOR_WINDOW(row, column, stride) { body } walks it; WINDOW_VALUE(window, tap, place) is its
// tap-th value, `place` pixels from the first.
#define TAPS(stride) (((SIDE - 1) / (stride) + 1) * ((SIDE - 1) / (stride) + 1))
#if FORM_ITEM
#include "item/sweep.cl"
#else
#include "group/sweep.cl"
#endif

// Bilinear sample at (u, v), where the centre of pixel (0, 0) is (0.5, 0.5); beyond the border of
// the photo, that of the border.
INLINE real sampled(__global const real2 *restrict image, int width, int2 size, real u, real v)
{
    const real x = fmin(fmax(u - (real)0.5, (real)0), (real)(size.x - 1)); // 0 for a nan
    const real y = fmin(fmax(v - (real)0.5, (real)0), (real)(size.y - 1));
    const int x0 = min((int)x, size.x - 2), y0 = min((int)y, size.y - 2);
    const real fx = x - x0, fy = y - y0;
    const real2 upper = image[y0 * width + x0], lower = image[y0 * width + x0 + width];
    const real above = upper.x + fx * (upper.y - upper.x);
    const real below = lower.x + fx * (lower.y - lower.x);
    return above + fy * (below - above);
}

// The place in a source of the pixel (x, y) at an inverse depth, homogeneous.
INLINE real3 warped(real x, real y, real inverse_depth, __global const real *restrict warp)
{
    return (real3)(warp[0], warp[3], warp[6]) * x + (real3)(warp[1], warp[4], warp[7]) * y
        + (real3)(warp[2], warp[5], warp[8]) + (real3)(warp[9], warp[10], warp[11]) * inverse_depth;
}

// The correlation of a window around (x, y) with its place in a source; NO_MATCH where that lies
// outside, or has no texture.
INLINE real correlation(const Window *window, int stride, real x, real y, real inverse_depth,
                        __global const real2 *restrict image, int width, int2 size,
                        __global const real *restrict warp)
{
    const real3 q = warped(x, y, inverse_depth, warp);
    if (!(q.z > 0) || min(size.x, size.y) < 2) // bilinear samples are between two pixels
        return NO_MATCH;
    const real u = q.x / q.z, v = q.y / q.z;
    if (!(u >= 0 && v >= 0 && u <= size.x && v <= size.y))
        return NO_MATCH;
    // a window is small, so its pixels follow the derivatives at its centre
    const real2 by_x = ((real2)(warp[0], warp[3]) - (real2)(u, v) * warp[6]) / q.z;
    const real2 by_y = ((real2)(warp[1], warp[4]) - (real2)(u, v) * warp[7]) / q.z;
    const int taps = TAPS(stride);
    real sum = 0, squares = 0, products = 0;
    int tap = 0;
    FOR_WINDOW(row, column, stride) {
        const real dx = column - REACH, dy = row - REACH;
        const real value = sampled(image, width, size, u + dx * by_x.x + dy * by_y.x,
                                   v + dx * by_x.y + dy * by_y.y) - window->mean;
        sum += value;
        squares += value * value;
        products += value * WINDOW_VALUE(window, tap++, row * width + column);
    }
    const real variance = squares / taps - sum / taps * (sum / taps);
    if (!(variance >= (real)LEAST_VARIANCE)) // nor for a nan
        return NO_MATCH;
    return products / taps / sqrt(window->variance * variance);
}

#define SOURCES                                                                                    \
    int width, int source_count, __global const real2 *restrict images,                            \
        __global const int *restrict sizes, __global const int *restrict sources,                  \
        __global const real *restrict warps
#define THE_SOURCES width, source_count, images, sizes, sources, warps

INLINE real score_of(const Window *window, int stride, real x, real y, real inverse_depth,
                     long plane, SOURCES)
{
    real best = NO_MATCH, second = NO_MATCH;
    for (int s = 0; s < source_count; s++) {
        const int source = sources[s];
        const real found = correlation(window, stride, x, y, inverse_depth, images + source * plane,
                                       width, vload2(source, sizes), warps + 12 * s);
        second = fmax(second, fmin(best, found));
        best = fmax(best, found);
    }
    return (best + second) / 2;
}

__kernel void sweep(int width, int height, int reference, int source_count, int planes, real first,
                    real spacing, __global const real2 *restrict images,
                    __global const int *restrict sizes, __global const int *restrict sources,
                    __global const real *restrict warps, __global real *restrict inverse_depths,
                    __global real *restrict scores)
{
    const long plane = (long)width * height, i = get_global_id(0);
    if (i >= plane)
        return;
    __global const real2 *own = images + reference * plane;
    const int2 size = vload2(reference, sizes);
    const int column = i % width, row = i / width;
    const real x = column + (real)0.5, y = row + (real)0.5;
    inverse_depths[i] = scores[i] = 0;
    if (column < REACH || row < REACH || column + REACH >= size.x || row + REACH >= size.y)
        return;
    Window window;
    load_window(&window, own, width, column, row, 2);
    if (!(window.variance >= (real)LEAST_VARIANCE))
        return;
    real best = NO_MATCH;
    int at = 0;
    for (int k = 0; k < planes; k++) {
        const real score = score_of(&window, 2, x, y, first + k * spacing, plane, THE_SOURCES);
        if (score > best) {
            best = score;
            at = k;
        }
    }
    if (at == 0 || at == planes - 1)
        return;
    load_window(&window, own, width, column, row, 1);
    if (!(window.variance >= (real)LEAST_VARIANCE)) // also where a pixel between does not count
        return;
    const real middle = first + at * spacing, fine = spacing / 2;
    real near[FINE];
    best = NO_MATCH;
    at = 0;
    for (int k = 0; k < FINE; k++) {
        near[k] = score_of(&window, 1, x, y, middle + (k - FINE / 2) * fine, plane, THE_SOURCES);
        if (near[k] > best) {
            best = near[k];
            at = k;
        }
    }
    if (!(best > NO_MATCH))
        return;
    real shift = 0;
    if (at > 0 && at < FINE - 1) {
        const real bend = near[at - 1] - 2 * best + near[at + 1]; // not above 0
        if (bend < (real)-1e-6)
            shift = clamp((near[at - 1] - near[at + 1]) / (2 * bend), (real)-0.5, (real)0.5);
    }
    inverse_depths[i] = middle + (at - FINE / 2 + shift) * fine;
    scores[i] = best;
}

// How many sources have the same depth as a pixel of the reference, where it projects to, with a
// relative difference below `same_depth`. The pixel's point lies at the inverse depth w / q.z of
// the source, where q is its warped place.
//
// images: those of inverse depths, 0 where there is none. confirmed: uint[H, W].
__kernel void confirm(int width, int height, int reference, int source_count, real same_depth,
                      __global const real2 *restrict images,
                      __global const int *restrict sizes, __global const int *restrict sources,
                      __global const real *restrict warps, __global uint *restrict confirmed)
{
    const long plane = (long)width * height, i = get_global_id(0);
    if (i >= plane)
        return;
    const real x = i % width + (real)0.5, y = i / width + (real)0.5;
    const real w = images[reference * plane + i].x;
    uint found = 0;
    for (int s = 0; s < source_count; s++) {
        const real3 q = warped(x, y, w, warps + 12 * s);
        const int2 size = vload2(sources[s], sizes);
        const real u = q.x / q.z, v = q.y / q.z;
        if (!(q.z > 0 && u >= 0 && v >= 0 && u < size.x && v < size.y)) // nor for a nan
            continue;
        const real there = q.z * images[sources[s] * plane + (int)v * width + (int)u].x;
        found += fabs(w - there) < same_depth * there;
    }
    confirmed[i] = found;
}
