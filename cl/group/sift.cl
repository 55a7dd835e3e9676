// Group form of sift.cl (see there): a work-item owns a pixel, a group a keypoint.
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_GROUP_SUM(group_sum, real)

// Rows of `smoothed` into an image of `levels`, and its difference to the image `before`.
__kernel void smooth_rows(uint width, uint height, uint stride, uint before, uint target,
                          uint difference, uint radius, __global const real *restrict taps,
                          __global real *restrict smoothed, __global real *restrict levels,
                          __global real *restrict differences)
{
    FOR_EACH(i, height * stride) {
        const int x = i % stride, last = width - 1;
        __global const real *row =
            smoothed + i / stride * (stride + 2 * SIFT_PADDING) + SIFT_PADDING;
        real sum = taps[0] * row[min(x, last)];
        for (int tap = 1; tap <= (int)radius; tap++)
            sum = MAD(taps[tap], row[clamp(x - tap, 0, last)] + row[min(x + tap, last)], sum);
        levels[target + i] = sum;
        differences[SIFT_PADDING + difference + i] = sum - levels[before + i];
    }
}

// Not left to the compiler: clang keeps what is called twice as a function, which in C99 is then
// nowhere, and of static ones PoCL 3.1 miscompiles the barriers.
#define WITH_BARRIERS inline __attribute__((always_inline))

// Samples of a grid, then length and direction (from 0 to `bins`) of their gradients.
WITH_BARRIERS void gradients(Surroundings from, real spacing, real angle, real sigma, int bins,
                             __local real *patch, __local real *lengths,
                             __local real *directions)
{
    const real cosine = cos(angle), sine = sin(angle);
    FOR_GROUP(index, PATCH * PATCH) {
        patch[index] = patch_sample(from, index, spacing, cosine, sine);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    FOR_GROUP(index, SAMPLES * SAMPLES) {
        const int row = index / SAMPLES, column = index % SAMPLES;
        __local const real *at = patch + (row + 1) * PATCH + column + 1;
        const real dx = at[1] - at[-1], dy = at[PATCH] - at[-PATCH];
        const real turn = atan2(dy, dx) * (real)(bins / TAU);
        lengths[index] =
            sqrt(dx * dx + dy * dy) * gaussian_of(column, sigma) * gaussian_of(row, sigma);
        directions[index] = turn < 0 ? turn + bins : turn;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// How much a direction counts for a bin: 1 where it points there, 0 from the neighbours on.
inline real share_of(real direction, int bin, int bins)
{
    const real away = fabs(direction - bin);
    return fmax(1 - fmin(away, bins - away), (real)0);
}

WITH_BARRIERS void describe_one(Surroundings from, real angle, __local real *patch,
                                __local real *lengths, __local real *directions,
                                __local real *values, __local real *scratch,
                                __global uchar *descriptor)
{
    gradients(from, DESCRIPTOR_SPACING, angle, DESCRIPTOR_SIGMA, DIRECTIONS, patch, lengths,
              directions);
    real squares = 0;
    FOR_GROUP(index, DESCRIPTOR_SIZE) {
        const int cell_row = index / 32, cell_column = index / 8 % 4, bin = index % 8;
        real sum = 0;
        for (int row = CELL * cell_row; row < CELL * (cell_row + 2); row++)
            for (int column = CELL * cell_column; column < CELL * (cell_column + 2); column++) {
                const real v = fabs((row - MIDDLE) / CELL - (cell_row - (real)1.5));
                const real u = fabs((column - MIDDLE) / CELL - (cell_column - (real)1.5));
                const int sample = row * SAMPLES + column;
                sum += (1 - v) * (1 - u) * lengths[sample] *
                       share_of(directions[sample], bin, DIRECTIONS);
            }
        values[index] = sum;
        squares += sum * sum;
    }
    // clipped and of length 1, then the root of each share
    const real limit = (real)MOST_OF_ONE * sqrt(group_sum(squares, scratch));
    real clipped = 0;
    FOR_GROUP(index, DESCRIPTOR_SIZE) {
        clipped += fmin(values[index], limit);
    }
    const real total = group_sum(clipped, scratch), scale = total > 0 ? 1 / total : 0;
    FOR_GROUP(index, DESCRIPTOR_SIZE) {
        descriptor[index] = convert_uchar_sat_rte(512 * sqrt(fmin(values[index], limit) * scale));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1))) void
describe(uint count, __global const real *restrict keypoints, __global const int *restrict octaves,
         __global const real *restrict levels, __global real *restrict angles,
         __global uchar *restrict descriptors)
{
    __local real patch[PATCH * PATCH], lengths[SAMPLES * SAMPLES], directions[SAMPLES * SAMPLES];
    __local real values[DESCRIPTOR_SIZE], scratch[GROUP];
    __local real2 found;
    const uint keypoint = get_group_id(0);
    const Surroundings from = surroundings(keypoint, keypoints, octaves, levels);
    gradients(from, ORIENTATION_SPACING, 0, ORIENTATION_SIGMA, TURNS, patch, lengths, directions);
    FOR_GROUP(bin, TURNS) {
        real sum = 0;
        for (int sample = 0; sample < SAMPLES * SAMPLES; sample++)
            sum += lengths[sample] * share_of(directions[sample], bin, TURNS);
        values[bin] = sum;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_local_id(0) == 0) {
        real turns[TURNS];
        for (int bin = 0; bin < TURNS; bin++)
            turns[bin] = values[bin];
        found = peaks(turns);
        vstore2(found, keypoint, angles);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const real2 both = found;
    if (both.x > NO_ANGLE)
        describe_one(from, both.x, patch, lengths, directions, values, scratch,
                     descriptors + 2 * DESCRIPTOR_SIZE * keypoint);
    if (both.y > NO_ANGLE)
        describe_one(from, both.y, patch, lengths, directions, values, scratch,
                     descriptors + DESCRIPTOR_SIZE * (2 * keypoint + 1));
}
