// Group form of image_loss.cl (see there): a group owns COLUMNS x ROWS pixels of one channel. It
// loads these with their halo; then a lane adds up the windows across of RUN neighbours in a row,
// and then, from these sums, the windows down of DOWN neighbours in a column: a value is read once
// for many windows.
#define GROUP (TILE * 8)
#include "group.h"
#define COLUMNS 32
#define ROWS 22
#define WIDE_COLUMNS (COLUMNS + 2 * RADIUS)
#define WIDE_ROWS (ROWS + 2 * RADIUS)
#define RUN 8
#define DOWN 6
#define TASKS 128 // runs of a tile, and neighbours in its columns
#define OWN_TASKS (TASKS / GROUP)
#if WIDE_ROWS * COLUMNS != TASKS * RUN || (ROWS + DOWN - 1) / DOWN * COLUMNS != TASKS ||           \
    TASKS % GROUP
#error "the tasks of a tile are to be the same number for all lanes"
#endif
// How many moments and maps go through local memory at once: all of them; on devices with waves of
// 64, where local memory for all would leave room for two waves a SIMD, one after another, with
// more barriers. Every sum has the same order in both.
#if WAVE == 64
#define MOMENTS_AT_ONCE 1
#define MAPS_AT_ONCE 1
typedef real Moments;
#define MOMENTS(batch, x, y)                                                                       \
    ((batch) == 0 ? (x) : (batch) == 1 ? (y) : (batch) == 2 ? (x) * (x) + (y) * (y) : (x) * (y))
#define MEAN(m) means[own][m][j]
#else
#define MOMENTS_AT_ONCE 4
#define MAPS_AT_ONCE 3
typedef real4 Moments;
#define MOMENTS(batch, x, y) (real4)(x, y, (x) * (x) + (y) * (y), (x) * (y))
#define MEAN(m) means[own][0][j].s##m
#endif
#define BATCHES (MEANS / MOMENTS_AT_ONCE)
// Rows in local memory. Where lanes read or write real4s of successive rows, these lie 4 or 12
// words apart, modulo 32, in different banks.
#define PITCH 44                // of values
#define MAP_PITCH 36            // of the sums across of a map
#define MOMENT_PITCH 33         // of the sums across of moments
#define SUM_ROWS (WIDE_ROWS + 2) // the lowest lanes go two rows too far down, and ignore these
#define MOMENT_REALS (SUM_ROWS * MOMENT_PITCH * MOMENTS_AT_ONCE)
#define VALUE_REALS (WIDE_ROWS * PITCH)
#define max_of(A, B) ((A) > (B) ? (A) : (B))

// The values that a run reads, from its first on.
#define RUN_VALUES (RUN + 2 * RADIUS)
#define RUN_VECTORS ((RUN_VALUES + 3) / 4)
inline void load_run(__local const real4 *from, real *values)
{
#pragma unroll
    for (int i = 0; i < RUN_VECTORS; i++) {
        const real4 next = from[i];
        values[4 * i] = next.x;
        values[4 * i + 1] = next.y;
        values[4 * i + 2] = next.z;
        values[4 * i + 3] = next.w;
    }
}

inline void load_run_of_bytes(__local const uchar4 *from, real *values)
{
#pragma unroll
    for (int i = 0; i < RUN_VECTORS; i++) {
        const real4 next = convert_real4(from[i]) * (real)(1.0 / 255);
        values[4 * i] = next.x;
        values[4 * i + 1] = next.y;
        values[4 * i + 2] = next.z;
        values[4 * i + 3] = next.w;
    }
}

// Adds value number K to the windows of COUNT neighbours, the first of which begins with number 0.
#define ADD_TO_WINDOWS(SUMS, COUNT, K, VALUE)                                                      \
    _Pragma("unroll") for (int j = 0; j < (COUNT); j++)                                            \
    {                                                                                              \
        if ((K) - j >= 0 && (K) - j < TAPS)                                                        \
            SUMS[j] += WINDOW[(K) - j] * (VALUE);                                                  \
    }

// A lane loads every AT_ONCE-th row of its column of the tile and its halo, LOADS in all: of pixel
// PIXEL_OF(i) of the channel, which INSIDE(i) tells not to stand in for one beyond the border, to
// `place` in row i AT_ONCE, if HAS_PLACE(i). All are loaded at once, and so without branches.
#define AT_ONCE (GROUP / WIDE_COLUMNS)
#define LOADS ((WIDE_ROWS + AT_ONCE - 1) / AT_ONCE)
#define LOCATE_HALO                                                                                \
    const int halo_row = lane / WIDE_COLUMNS, halo_column = lane % WIDE_COLUMNS;                   \
    const int halo_x = x0 - RADIUS + halo_column, halo_y = y0 - RADIUS + halo_row;                 \
    const int near_x = clamp(halo_x, 0, width - 1);                                                \
    __local real *place = values + halo_row * PITCH + halo_column
#define NEAR_Y(i) clamp(halo_y + (i) * AT_ONCE, 0, height - 1)
#define PIXEL_OF(i) (NEAR_Y(i) * width + near_x)
#define INSIDE(i) (halo_x == near_x && halo_y + (i) * AT_ONCE == NEAR_Y(i))
#if MASKED
#define COUNTS(PIXEL) (mask[PIXEL] != 0)
#else
#define COUNTS(PIXEL) true
#endif
#define HAS_PLACE(i) (halo_row < AT_ONCE && halo_row + (i) * AT_ONCE < WIDE_ROWS)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void image_loss(int width, int height, __global const real *restrict image,
                __global const uchar *restrict photo, __global real *restrict partials,
                __global real *restrict maps)
{
    // first x and 255 y, then moments, then totals
    __local real4 memory[max_of(MOMENT_REALS, VALUE_REALS + VALUE_REALS / 4) / 4];
    __local real *values = (__local real *)memory;
    __local uchar4 *bytes = (__local uchar4 *)(values + VALUE_REALS);
    const int group = get_group_id(0), lane = get_local_id(0);
    LOCATE_PART(group, COLUMNS, ROWS);
    LOCATE_HALO;
    __global const real *channel_image = image + channel * plane;
    __global const uchar *channel_photo = photo + channel * plane;
#if MASKED
    __global const uchar *mask = photo + 3 * plane;
#endif
    real loaded_x[LOADS];
    uchar loaded_y[LOADS];
#pragma unroll
    for (int i = 0; i < LOADS; i++) {
        const real x = channel_image[PIXEL_OF(i)];
        const uchar y = channel_photo[PIXEL_OF(i)];
        const bool counts = INSIDE(i) && COUNTS(PIXEL_OF(i));
        loaded_x[i] = counts ? x : 0;
        loaded_y[i] = counts ? y : 0;
    }
#pragma unroll
    for (int i = 0; i < LOADS; i++)
        if (HAS_PLACE(i)) {
            place[i * AT_ONCE * PITCH] = loaded_x[i];
            ((__local uchar *)bytes + (place - values))[i * AT_ONCE * PITCH] = loaded_y[i];
        }
    barrier(CLK_LOCAL_MEM_FENCE);

    Moments row_sums[OWN_TASKS][BATCHES][RUN];
    real2 totals[OWN_TASKS]; // |x - y|, SSIM
#pragma unroll
    for (int own = 0; own < OWN_TASKS; own++) {
        const int row = (own * GROUP + lane) % WIDE_ROWS, run = (own * GROUP + lane) / WIDE_ROWS;
        real x[4 * RUN_VECTORS], y[4 * RUN_VECTORS];
        const int from = row * (PITCH / 4) + run * (RUN / 4);
        load_run(memory + from, x);
        load_run_of_bytes(bytes + from, y);
        totals[own] = 0;
#pragma unroll
        for (int j = 0; j < RUN; j++) {
#pragma unroll
            for (int batch = 0; batch < BATCHES; batch++)
                row_sums[own][batch][j] = 0;
            totals[own].x += fabs(x[RADIUS + j] - y[RADIUS + j]); // zero outside the image
        }
        if (row < RADIUS || row >= RADIUS + ROWS)
            totals[own].x = 0;
#pragma unroll
        for (int k = 0; k < RUN_VALUES; k++)
#pragma unroll
            for (int batch = 0; batch < BATCHES; batch++) {
                const Moments moments = MOMENTS(batch, x[k], y[k]);
                ADD_TO_WINDOWS(row_sums[own][batch], RUN, k, moments);
            }
    }
    __local Moments *sums_across = (__local Moments *)memory;
    Moments means[OWN_TASKS][BATCHES][DOWN];
#pragma unroll
    for (int batch = 0; batch < BATCHES; batch++) {
        barrier(CLK_LOCAL_MEM_FENCE);
#pragma unroll
        for (int own = 0; own < OWN_TASKS; own++) {
            const int row = (own * GROUP + lane) % WIDE_ROWS;
            const int run = (own * GROUP + lane) / WIDE_ROWS;
#pragma unroll
            for (int j = 0; j < RUN; j++)
                sums_across[row * MOMENT_PITCH + run * RUN + j] = row_sums[own][batch][j];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
#pragma unroll
        for (int own = 0; own < OWN_TASKS; own++) {
            const int column = lane % COLUMNS, first = (own * GROUP + lane) / COLUMNS * DOWN;
#pragma unroll
            for (int j = 0; j < DOWN; j++)
                means[own][batch][j] = 0;
#pragma unroll
            for (int k = 0; k < DOWN + 2 * RADIUS; k++) {
                const Moments moments = sums_across[(first + k) * MOMENT_PITCH + column];
                ADD_TO_WINDOWS(means[own][batch], DOWN, k, moments);
            }
        }
    }

#pragma unroll
    for (int own = 0; own < OWN_TASKS; own++) {
        const int column = lane % COLUMNS, first = (own * GROUP + lane) / COLUMNS * DOWN;
        __global real *own_maps =
            maps + 3 * channel * plane + (long)(y0 + first) * width + x0 + column;
#pragma unroll
        for (int j = 0; j < DOWN; j++)
            if (x0 + column < width && y0 + first + j < height && first + j < ROWS) {
                __global real *map = own_maps + j * width;
                real by_x, by_xx, by_xy;
                const real value =
                    ssim(MEAN(0), MEAN(1), MEAN(2), MEAN(3), &by_x, &by_xx, &by_xy);
                const bool counts = COUNTS((long)(y0 + first + j) * width + x0 + column);
                totals[own].y += counts ? value : 1;
                map[0] = counts ? by_x : 0;
                map[plane] = counts ? by_xx : 0;
                map[2 * plane] = counts ? by_xy : 0;
            }
    }
    barrier(CLK_LOCAL_MEM_FENCE);

    // in two steps, and in an order that does not depend on GROUP
    __local real2 *sums = (__local real2 *)memory;
    for (int own = 0; own < OWN_TASKS; own++)
        sums[own * GROUP + lane] = totals[own];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lane < TASKS / 8)
        for (int i = 1; i < 8; i++)
            sums[lane] += sums[i * (TASKS / 8) + lane];
    barrier(CLK_LOCAL_MEM_FENCE);
    if (lane == 0) {
        real2 total = sums[0];
        for (int i = 1; i < TASKS / 8; i++)
            total += sums[i];
        vstore2(total, group, partials);
    }
}

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void image_loss_adjoint(int width, int height, __global const real *restrict image,
                        __global const uchar *restrict photo, __global const real *restrict maps,
                        real l1_scale, real ssim_scale, __global real *restrict grad_image)
{
    // first values of maps, then sums across
    __local real4 memory[MAPS_AT_ONCE * VALUE_REALS / 4];
    __local real *values = (__local real *)memory;
    const int group = get_group_id(0), lane = get_local_id(0);
    LOCATE_PART(group, COLUMNS, ROWS);
    LOCATE_HALO;
#if MASKED
    __global const uchar *mask = photo + 3 * plane;
#endif
    real row_sums[OWN_TASKS][3][RUN], by[OWN_TASKS][3][DOWN];
#pragma unroll
    for (int batch = 0; batch < 3; batch += MAPS_AT_ONCE) {
#pragma unroll
        for (int m = 0; m < MAPS_AT_ONCE; m++) {
            __global const real *map = maps + (3 * channel + batch + m) * plane;
            real loaded[LOADS];
#pragma unroll
            for (int i = 0; i < LOADS; i++)
                loaded[i] = map[PIXEL_OF(i)];
            if (batch)
                barrier(CLK_LOCAL_MEM_FENCE);
#pragma unroll
            for (int i = 0; i < LOADS; i++)
                if (HAS_PLACE(i))
                    place[(m * WIDE_ROWS + i * AT_ONCE) * PITCH] = INSIDE(i) ? loaded[i] : 0;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
#pragma unroll
        for (int own = 0; own < OWN_TASKS; own++) {
            const int row = (own * GROUP + lane) % WIDE_ROWS;
            const int run = (own * GROUP + lane) / WIDE_ROWS;
            __local const real4 *from = memory + row * (PITCH / 4) + run * (RUN / 4);
#pragma unroll
            for (int m = 0; m < MAPS_AT_ONCE; m++) {
                real of_map[4 * RUN_VECTORS];
                load_run(from + m * (VALUE_REALS / 4), of_map);
#pragma unroll
                for (int j = 0; j < RUN; j++)
                    row_sums[own][batch + m][j] = 0;
#pragma unroll
                for (int k = 0; k < RUN_VALUES; k++)
                    ADD_TO_WINDOWS(row_sums[own][batch + m], RUN, k, of_map[k]);
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
#pragma unroll
        for (int own = 0; own < OWN_TASKS; own++) {
            const int row = (own * GROUP + lane) % WIDE_ROWS;
            const int run = (own * GROUP + lane) / WIDE_ROWS;
            __local real4 *row_to = memory + row * (MAP_PITCH / 4) + run * (RUN / 4);
#pragma unroll
            for (int m = 0; m < MAPS_AT_ONCE; m++) {
                const real *sums = row_sums[own][batch + m];
                __local real4 *to = row_to + m * (SUM_ROWS * MAP_PITCH / 4);
                to[0] = (real4)(sums[0], sums[1], sums[2], sums[3]);
                to[1] = (real4)(sums[4], sums[5], sums[6], sums[7]);
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
#pragma unroll
        for (int own = 0; own < OWN_TASKS; own++) {
            const int column = lane % COLUMNS, first = (own * GROUP + lane) / COLUMNS * DOWN;
            __local const real *column_sums = values + first * MAP_PITCH + column;
#pragma unroll
            for (int m = 0; m < MAPS_AT_ONCE; m++) {
#pragma unroll
                for (int j = 0; j < DOWN; j++)
                    by[own][batch + m][j] = 0;
#pragma unroll
                for (int k = 0; k < DOWN + 2 * RADIUS; k++) {
                    const real sum = column_sums[(m * SUM_ROWS + k) * MAP_PITCH];
                    ADD_TO_WINDOWS(by[own][batch + m], DOWN, k, sum);
                }
            }
        }
    }

#pragma unroll
    for (int own = 0; own < OWN_TASKS; own++) {
        const int column = lane % COLUMNS, first = (own * GROUP + lane) / COLUMNS * DOWN;
        const long own_pixel = channel * plane + (long)(y0 + first) * width + x0 + column;
#pragma unroll
        for (int j = 0; j < DOWN; j++)
            if (x0 + column < width && y0 + first + j < height && first + j < ROWS) {
                const long pixel = own_pixel + j * width;
                const real x = image[pixel], y = photo[pixel] * (real)(1.0 / 255);
                const real by_x = by[own][0][j], by_xx = by[own][1][j], by_xy = by[own][2][j];
                const real gradient = l1_scale * sign(x - y) +
                                      ssim_scale * (by_x + 2 * x * by_xx + y * by_xy);
                grad_image[pixel] = COUNTS(pixel - channel * plane) ? gradient : 0;
            }
    }
}
