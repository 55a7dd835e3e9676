// SIFT (Lowe 2004): blobs of a photo at all scales, each with a description that does not depend on
// its turn and size, as RootSIFT (Arandjelovic and Zisserman 2012).
//
//   grey     the photo as luminance, enlarged where it is small
//   smooth   scale space: SIFT_LEVELS images an octave, each a Gaussian of the one before, sigma
//            SIFT_SIGMA 2^(level / SIFT_SCALES); rows and columns apart; halve begins the next one
//   extrema  of the differences of levels in 3 x 3 x 3 pixels, refined by a parabola in x, y and
//            scale (section 4), without weak ones and edges (4.1)
//   describe one or two orientations of a keypoint (5), then 4 x 4 histograms of 8 directions (6.1)
//
// A keypoint's surroundings are sampled on a grid of SAMPLES x SAMPLES, turned and spaced with it,
// from the level of its scale: the grid of 6.1, and two samples more on each side, so that the
// outer histograms are whole. Its spacing, 0.75 sigma, shows all that this blur has left. Gradients
// are differences on that grid.
//
// levels: real[L], all octaves; octaves: int[O, 4], where one begins, its width, height and stride
// (a multiple of 16; columns from the width on are of no use). differences: of one octave, real[5,
// height, stride] with SIFT_PADDING before and behind, as neighbours are read beyond the corners.
// keypoints: real[N, 4]: x, y, in pixels of its octave with the centre of the first at 0, level (a
// fraction), octave; cells: uint[N], where it was found, no two alike; found: uint[1], how many
// there are, also where these are more than the arrays hold. Their order is that in which
// work-items come (one integer atomic), so the host sorts by cells.
// angles: real[N, 2], NO_ANGLE for none; descriptors: uchar[N, 2, 128].
#include "real.h"
#include "each.h"
#include "vector.h"

#define LEAST_CONTRAST (0.02 / SIFT_SCALES) // of differences, where white is 1
#define LEAST_SEEN (0.8 * LEAST_CONTRAST) // before the refinement
#define LARGEST_RATIO 10 // of the two curvatures; edges have more
#define MOST_MOVES 5 // of a refinement to a neighbour

#define SAMPLES 20
#define PATCH (SAMPLES + 2) // with neighbours for differences
#define MIDDLE ((SAMPLES - 1) / (real)2)
#define ORIENTATION_SPACING 0.48 // sigma, so that the grid ends at 4.5 sigma
#define ORIENTATION_SIGMA (1.5 / ORIENTATION_SPACING) // samples
#define DESCRIPTOR_SPACING 0.75 // sigma; 4 samples are a cell of 3 sigma
#define CELL 4 // samples
#define DESCRIPTOR_SIGMA (2 * CELL) // samples
#define TURNS 36 // bins of orientations
#define DIRECTIONS 8
#define NEARLY_HIGHEST 0.8 // of the highest peak of orientations
#define MOST_OF_ONE 0.2 // of a descriptor of length 1
#define TAU 6.283185307179586

__kernel void grey(uint source_width, uint source_height, uint width, uint height, uint stride,
                   uint target, __global const uchar *restrict pixels,
                   __global real *restrict levels)
{
    FOR_EACH(i, height * stride) {
        const uint y = i / stride, x = min((uint)(i % stride), width - 1);
        const real u = ((x + (real)0.5) * source_width) / width - (real)0.5;
        const real v = ((y + (real)0.5) * source_height) / height - (real)0.5;
        const real column = fmin(fmax(u, (real)0), (real)(source_width - 1));
        const real row = fmin(fmax(v, (real)0), (real)(source_height - 1));
        const uint left = column, top = row;
        const uint right = min(left + 1, source_width - 1), low = min(top + 1, source_height - 1);
        const real fx = column - left, fy = row - top;
#define LUMINANCE(X, Y)                                                                            \
    ((real)0.299 * pixels[3 * ((Y) * source_width + (X))] +                                        \
     (real)0.587 * pixels[3 * ((Y) * source_width + (X)) + 1] +                                    \
     (real)0.114 * pixels[3 * ((Y) * source_width + (X)) + 2])
        levels[target + i] =
            ((1 - fy) * ((1 - fx) * LUMINANCE(left, top) + fx * LUMINANCE(right, top)) +
             fy * ((1 - fx) * LUMINANCE(left, low) + fx * LUMINANCE(right, low))) /
            255;
    }
}

// Columns of an image of `levels`, into rows of `smoothed` with SIFT_PADDING on both sides. taps:
// real[radius + 1].
__kernel void smooth_columns(uint width, uint height, uint stride, uint source, uint radius,
                             __global const real *restrict taps,
                             __global const real *restrict levels, __global real *restrict smoothed)
{
    FOR_EACH(i, height * (stride / VREAL_WIDTH)) {
        const int y = i / (stride / VREAL_WIDTH), x = i % (stride / VREAL_WIDTH) * VREAL_WIDTH;
        __global const real *image = levels + source + x;
        vreal sum = taps[0] * LOAD(image + y * stride);
        for (int tap = 1; tap <= (int)radius; tap++) {
            const int above = max(y - tap, 0), below = min(y + tap, (int)height - 1);
            sum = MAD((vreal)taps[tap], LOAD(image + above * stride) + LOAD(image + below * stride),
                      sum);
        }
        STORE(sum, smoothed + y * (stride + 2 * SIFT_PADDING) + SIFT_PADDING + x);
    }
}

// Every second pixel of an image, the first of the next octave.
__kernel void halve(uint width, uint height, uint stride, uint source_stride, uint source,
                    uint target, __global real *restrict levels)
{
    FOR_EACH(i, height * stride) {
        const uint y = i / stride, x = min((uint)(i % stride), width - 1);
        levels[target + i] = levels[source + 2 * (y * source_stride + x)];
    }
}

// The value at (x, y) of level `level` of the differences, and its neighbours in all directions.
#define AT(DX, DY, DL) here[(DX) + (DY) * (int)stride + (DL) * (int)layer]

// Moves a maximum or minimum at an integer place to where the parabola through its neighbours has
// it; false where there is none, or it is weak or on an edge.
INLINE bool refine(__global const real *differences, uint width, uint height, uint stride, int x,
                   int y, int level, real *found_x, real *found_y, real *found_level, uint *cell)
{
    const uint layer = height * stride;
    for (int move = 0; move < MOST_MOVES; move++) {
        __global const real *here = differences + SIFT_PADDING + level * layer + y * stride + x;
        const real middle = 2 * AT(0, 0, 0);
        const real gx = (AT(1, 0, 0) - AT(-1, 0, 0)) / 2, gy = (AT(0, 1, 0) - AT(0, -1, 0)) / 2;
        const real gs = (AT(0, 0, 1) - AT(0, 0, -1)) / 2;
        const real xx = AT(1, 0, 0) + AT(-1, 0, 0) - middle,
                   yy = AT(0, 1, 0) + AT(0, -1, 0) - middle;
        const real ss = AT(0, 0, 1) + AT(0, 0, -1) - middle;
        const real xy = (AT(1, 1, 0) - AT(-1, 1, 0) - AT(1, -1, 0) + AT(-1, -1, 0)) / 4;
        const real xs = (AT(1, 0, 1) - AT(-1, 0, 1) - AT(1, 0, -1) + AT(-1, 0, -1)) / 4;
        const real ys = (AT(0, 1, 1) - AT(0, -1, 1) - AT(0, 1, -1) + AT(0, -1, -1)) / 4;
        // - H^-1 g, by cofactors
        const real c0 = yy * ss - ys * ys, c1 = xs * ys - xy * ss, c2 = xy * ys - xs * yy;
        const real det = xx * c0 + xy * c1 + xs * c2;
        if (det == 0)
            return false;
        const real dx = -(c0 * gx + c1 * gy + c2 * gs) / det;
        const real dy = -(c1 * gx + (xx * ss - xs * xs) * gy + (xy * xs - xx * ys) * gs) / det;
        const real ds = -(c2 * gx + (xy * xs - xx * ys) * gy + (xx * yy - xy * xy) * gs) / det;
        const int step_x = (dx > (real)0.6 && x < (int)width - 2) - (dx < (real)-0.6 && x > 1);
        const int step_y = (dy > (real)0.6 && y < (int)height - 2) - (dy < (real)-0.6 && y > 1);
        if ((step_x || step_y) && move < MOST_MOVES - 1) {
            x += step_x;
            y += step_y;
            continue;
        }
        const real value = AT(0, 0, 0) + (gx * dx + gy * dy + gs * ds) / 2;
        const real trace = xx + yy, curvature = xx * yy - xy * xy;
        const real most = (real)((LARGEST_RATIO + 1.0) * (LARGEST_RATIO + 1) / LARGEST_RATIO);
        *found_x = x + dx;
        *found_y = y + dy;
        *found_level = level + ds;
        *cell = level * layer + y * stride + x;
        return fabs(value) >= (real)LEAST_CONTRAST && curvature > 0 &&
               trace * trace < most * curvature &&
               fmax(fabs(dx), fmax(fabs(dy), fabs(ds))) < (real)1.5 && *found_x >= 0 &&
               *found_x <= width - 1 && *found_y >= 0 && *found_y <= height - 1 &&
               *found_level >= 0 && *found_level <= SIFT_LEVELS - 1;
    }
    return false;
}

// first_cell: of this octave; room: how many keypoints the arrays hold.
__kernel void extrema(uint width, uint height, uint stride, uint octave, uint first_cell, uint room,
                      __global const real *restrict differences, __global real *restrict keypoints,
                      __global uint *restrict cells, __global uint *restrict found)
{
    const uint layer = height * stride, blocks = stride / VREAL_WIDTH;
    FOR_EACH(i, SIFT_SCALES * (height - 2) * blocks) {
        const int level = 1 + i / ((height - 2) * blocks), y = 1 + i / blocks % (height - 2);
        const int first = i % blocks * VREAL_WIDTH;
        __global const real *here = differences + SIFT_PADDING + level * layer + y * stride + first;
        const vreal value = LOAD(here);
        if (!ANY(fabs(value) > (real)LEAST_SEEN))
            continue;
        vreal most = -1, least = 1;
#define COMPARE(DX, DY, DL)                                                                        \
    {                                                                                              \
        const vreal other = LOAD(&AT(DX, DY, DL));                                                 \
        most = fmax(most, other);                                                                  \
        least = fmin(least, other);                                                                \
    }
#define COMPARE_ROW(DY, DL)                                                                        \
    COMPARE(-1, DY, DL)                                                                            \
    COMPARE(0, DY, DL)                                                                             \
    COMPARE(1, DY, DL)
        COMPARE_ROW(-1, -1)
        COMPARE_ROW(0, -1)
        COMPARE_ROW(1, -1)
        COMPARE_ROW(-1, 0)
        COMPARE(-1, 0, 0)
        COMPARE(1, 0, 0)
        COMPARE_ROW(1, 0)
        COMPARE_ROW(-1, 1)
        COMPARE_ROW(0, 1)
        COMPARE_ROW(1, 1)
        const vmask extreme =
            TO_MASK(((value > most) | (value < least)) & (fabs(value) > (real)LEAST_SEEN));
        if (!ANY(extreme))
            continue;
        int lanes[VREAL_WIDTH];
        STORE_MASK(extreme, lanes);
        for (int lane = 0; lane < VREAL_WIDTH; lane++) {
            const int x = first + lane;
            if (!lanes[lane])
                continue;
            if (x < 1 || x > (int)width - 2)
                continue;
            real column, row, scale;
            uint cell;
            if (!refine(differences, width, height, stride, x, y, level, &column, &row, &scale,
                        &cell))
                continue;
            const uint slot = atomic_inc(found);
            if (slot < room) {
                vstore4((real4)(column, row, scale, octave), slot, keypoints);
                cells[slot] = first_cell + cell;
            }
        }
    }
}

// A bilinear sample; beyond the border, that of the border.
INLINE real sampled(__global const real *image, int width, int height, int stride, real x, real y)
{
    x = fmin(fmax(x, (real)0), (real)(width - 1));
    y = fmin(fmax(y, (real)0), (real)(height - 1));
    const int left = min((int)x, width - 2), top = min((int)y, height - 2);
    const real fx = x - left, fy = y - top;
    __global const real *at = image + top * stride + left;
    const real above = MAD(fx, at[1] - at[0], at[0]);
    const real below = MAD(fx, at[stride + 1] - at[stride], at[stride]);
    return MAD(fy, below - above, above);
}

// What a grid around a keypoint is sampled from, and how it lies there.
typedef struct {
    __global const real *image;
    int width, height, stride;
    real x, y, sigma;
} Surroundings;

INLINE Surroundings surroundings(uint keypoint, __global const real *keypoints,
                                 __global const int *octaves, __global const real *levels)
{
    const real4 at = vload4(keypoint, keypoints);
    const int4 octave = vload4((int)at.w, octaves);
    const int level = clamp((int)(at.z + (real)0.5), 0, SIFT_LEVELS - 1);
    const Surroundings result = {
        levels + octave.x + level * octave.z * octave.w, octave.y, octave.z, octave.w, at.x, at.y,
        (real)SIFT_SIGMA * exp2(at.z / SIFT_SCALES)};
    return result;
}

// Sample `index` of the PATCH x PATCH ones that are `spacing` sigma apart and turned by an angle.
INLINE real patch_sample(Surroundings from, int index, real spacing, real cosine, real sine)
{
    const real u = (index % PATCH - 1 - MIDDLE) * spacing * from.sigma;
    const real v = (index / PATCH - 1 - MIDDLE) * spacing * from.sigma;
    return sampled(from.image, from.width, from.height, from.stride, from.x + cosine * u - sine * v,
                   from.y + sine * u + cosine * v);
}

// How much a sample at distance `away` of a grid's middle counts, in one direction.
INLINE real gaussian_of(int index, real sigma)
{
    const real away = (index - MIDDLE) / sigma;
    return exp(away * away / -2);
}

// One or two orientations by a histogram of TURNS directions, the highest peak first.
INLINE real2 peaks(real *turns)
{
    for (int pass = 0; pass < 6; pass++) { // nearly a Gaussian
        const real first = turns[0];
        real before = turns[TURNS - 1];
        for (int bin = 0; bin < TURNS; bin++) {
            const real own = turns[bin], next = bin < TURNS - 1 ? turns[bin + 1] : first;
            turns[bin] = (before + own + next) / 3;
            before = own;
        }
    }
    real highest = 0, height = 0, second_height = 0;
    real2 result = NO_ANGLE;
    for (int bin = 0; bin < TURNS; bin++)
        highest = fmax(highest, turns[bin]);
    for (int bin = 0; bin < TURNS; bin++) {
        const real own = turns[bin], before = turns[(bin + TURNS - 1) % TURNS];
        const real next = turns[(bin + 1) % TURNS];
        if (!(own > before && own > next && own > (real)NEARLY_HIGHEST * highest))
            continue;
        const real shift = (before - next) / (2 * (before - 2 * own + next));
        const real angle = (bin + shift) * (real)(TAU / TURNS);
        if (own > height) {
            result.y = result.x;
            second_height = height;
            result.x = angle;
            height = own;
        } else if (own > second_height) {
            result.y = angle;
            second_height = own;
        }
    }
    return result;
}

#if FORM_ITEM
#include "item/sift.cl"
#else
#include "group/sift.cl"
#endif
