// Item form of image_loss.cl (see there), for CPUs: value and gradient in one pass, so that the
// maps never leave the cache. A work-item slides down a strip of 16 VECTORS columns and `strip`
// rows of a channel. At row y the sums across the image join a ring of the last TAPS rows; the maps
// of row y - RADIUS are complete, and their sums across join another ring; the gradient of row y -
// 2 RADIUS is complete.
#include "prefetch.h"

#define VECTORS 4
#define IMAGE_VECTORS (VECTORS + 2) // from 2 RADIUS columns before the strip on
#define MAP_VECTORS (VECTORS + 1)   // from RADIUS columns before it on
#define MAPS 3
#define ROWS_AHEAD 2 // rows of the image that are asked for early: no processor foresees them

// The 16 values that begin K after the first of A, which B continues; spelled out, LLVM 14 makes
// one shuffle of them.
#define AFTER_1(A, B)                                                                              \
    (real16)(A.s1, A.s2, A.s3, A.s4, A.s5, A.s6, A.s7, A.s8,                                       \
             A.s9, A.sa, A.sb, A.sc, A.sd, A.se, A.sf, B.s0)
#define AFTER_2(A, B)                                                                              \
    (real16)(A.s2, A.s3, A.s4, A.s5, A.s6, A.s7, A.s8, A.s9,                                       \
             A.sa, A.sb, A.sc, A.sd, A.se, A.sf, B.s0, B.s1)
#define AFTER_3(A, B)                                                                              \
    (real16)(A.s3, A.s4, A.s5, A.s6, A.s7, A.s8, A.s9, A.sa,                                       \
             A.sb, A.sc, A.sd, A.se, A.sf, B.s0, B.s1, B.s2)
#define AFTER_4(A, B)                                                                              \
    (real16)(A.s4, A.s5, A.s6, A.s7, A.s8, A.s9, A.sa, A.sb,                                       \
             A.sc, A.sd, A.se, A.sf, B.s0, B.s1, B.s2, B.s3)
#define AFTER_5(A, B)                                                                              \
    (real16)(A.s5, A.s6, A.s7, A.s8, A.s9, A.sa, A.sb, A.sc,                                       \
             A.sd, A.se, A.sf, B.s0, B.s1, B.s2, B.s3, B.s4)
#define AFTER_6(A, B)                                                                              \
    (real16)(A.s6, A.s7, A.s8, A.s9, A.sa, A.sb, A.sc, A.sd,                                       \
             A.se, A.sf, B.s0, B.s1, B.s2, B.s3, B.s4, B.s5)
#define AFTER_7(A, B)                                                                              \
    (real16)(A.s7, A.s8, A.s9, A.sa, A.sb, A.sc, A.sd, A.se,                                       \
             A.sf, B.s0, B.s1, B.s2, B.s3, B.s4, B.s5, B.s6)
#define AFTER_8(A, B)                                                                              \
    (real16)(A.s8, A.s9, A.sa, A.sb, A.sc, A.sd, A.se, A.sf,                                       \
             B.s0, B.s1, B.s2, B.s3, B.s4, B.s5, B.s6, B.s7)
#define AFTER_9(A, B)                                                                              \
    (real16)(A.s9, A.sa, A.sb, A.sc, A.sd, A.se, A.sf, B.s0,                                       \
             B.s1, B.s2, B.s3, B.s4, B.s5, B.s6, B.s7, B.s8)
#define AFTER_10(A, B)                                                                             \
    (real16)(A.sa, A.sb, A.sc, A.sd, A.se, A.sf, B.s0, B.s1,                                       \
             B.s2, B.s3, B.s4, B.s5, B.s6, B.s7, B.s8, B.s9)

// The window is symmetric: what lies at the same distance is added first.
inline real16 window(real16 v0, real16 v1, real16 v2, real16 v3, real16 v4, real16 v5, real16 v6,
                     real16 v7, real16 v8, real16 v9, real16 v10)
{
    return WINDOW[5] * v5 + WINDOW[4] * (v4 + v6) + WINDOW[3] * (v3 + v7) + WINDOW[2] * (v2 + v8) +
           WINDOW[1] * (v1 + v9) + WINDOW[0] * (v0 + v10);
}

inline real16 window_across(real16 a, real16 b)
{
    return window(a, AFTER_1(a, b), AFTER_2(a, b), AFTER_3(a, b), AFTER_4(a, b), AFTER_5(a, b),
                  AFTER_6(a, b), AFTER_7(a, b), AFTER_8(a, b), AFTER_9(a, b), AFTER_10(a, b));
}

// Row `number` and the ten before it of a ring, oldest first; `step` vectors a row.
#define LAST_ROWS(ROWS, RING, STEP, NUMBER)                                                        \
    const real16 *ROWS[TAPS];                                                                      \
    for (int k = 0, slot = SLOT((NUMBER) + 1); k < TAPS;                                           \
         k++, slot = slot + 1 < TAPS ? slot + 1 : 0)                                               \
        ROWS[k] = RING + slot * (STEP);
#define SLOT(NUMBER) (((NUMBER) + 2 * TAPS) % TAPS) // a row's place in a ring, from -2 TAPS on

// Down the rows of one vector of sums.
inline real16 window_down(const real16 *const rows[TAPS], int i)
{
    return window(rows[0][i], rows[1][i], rows[2][i], rows[3][i], rows[4][i], rows[5][i],
                  rows[6][i], rows[7][i], rows[8][i], rows[9][i], rows[10][i]);
}

inline real16 image16(__global const real *values)
{
    return vload16(0, values);
}

inline real16 photo16(__global const uchar *values)
{
    return convert_real16(vload16(0, values)) * (real)(1.0 / 255);
}

// `count` vectors of a row from column `first` on, zeros outside the image: `padded` has them from
// the beginning, and a call for other columns has a `padded` of its own.
#define PADDED (IMAGE_VECTORS * 16)
#define DEFINE_LOAD(NAME, TYPE, LOAD16, FACTOR)                                                    \
    INLINE void NAME(__global const TYPE *row, int first, int count, int width, real *padded,      \
                     real16 *values)                                                               \
    {                                                                                              \
        if (first >= 0 && first + 16 * count <= width) {                                           \
            for (int v = 0; v < count; v++)                                                        \
                values[v] = LOAD16(row + first + 16 * v);                                          \
            return;                                                                                \
        }                                                                                          \
        const int begin = max(first, 0), end = min(first + 16 * count, width);                     \
        if (end - begin < 16) {                                                                    \
            for (int x = begin; x < end; x++)                                                      \
                padded[x - first] = row[x] * (real)(FACTOR);                                       \
        } else { /* the last vector ends where the image does */                                   \
            for (int x = begin; x < end; x += 16)                                                  \
                vstore16(LOAD16(row + min(x, end - 16)), 0, padded + min(x, end - 16) - first);    \
        }                                                                                          \
        for (int v = 0; v < count; v++)                                                            \
            values[v] = vload16(v, padded);                                                        \
    }
DEFINE_LOAD(load_image, real, image16, 1)
DEFINE_LOAD(load_photo, uchar, photo16, 1.0 / 255)

// MASK_ROW reads COUNT vectors of the mask's row Y from column FIRST on; COUNTED_ELSE is VALUE at
// pixels of vector V that count, and ELSE at others.
#if MASKED
#define MASK_ROW(Y, FIRST, COUNT, PADDED_ROW)                                                      \
    real16 mask_row[COUNT];                                                                        \
    load_photo(mask + (long)(Y)*width, FIRST, COUNT, width, PADDED_ROW, mask_row)
#define COUNTED_ELSE(V, VALUE, ELSE) select((real16)(ELSE), VALUE, TO_MASK(mask_row[V] > 0))
#else
#define MASK_ROW(Y, FIRST, COUNT, PADDED_ROW)
#define COUNTED_ELSE(V, VALUE, ELSE) (VALUE)
#endif
#define COUNTED(V, VALUE) COUNTED_ELSE(V, VALUE, 0)

// A vector of a row, as far as the image goes.
inline void store_row(real16 value, __global real *row, int columns)
{
    if (columns >= 16) {
        vstore16(value, 0, row);
        return;
    }
    real values[16];
    vstore16(value, 0, values);
    for (int i = 0; i < columns; i++)
        row[i] = values[i];
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void image_loss(int width, int height, __global const real *restrict image,
                __global const uchar *restrict photo, __global real *restrict partials, int strip,
                real l1_scale, real ssim_scale, __global real *restrict grad_image)
{
    LOCATE_PART(get_global_id(0), 16 * VECTORS, strip);
    const int x_end = min(x0 + 16 * VECTORS, width), y_end = min(y0 + strip, height);
    const int wide_x0 = max(x0 - 2 * RADIUS, 0), wide_x_end = min(x_end + 2 * RADIUS, width);
    image += channel * plane;
#if MASKED
    __global const uchar *mask = photo + 3 * plane;
#endif
    photo += channel * plane;
    grad_image += channel * plane;
    real padded[4 + 3 * MASKED][PADDED];
    for (int p = 0; p < 4 + 3 * MASKED; p++)
        for (int i = 0; i < PADDED; i++)
            padded[p][i] = 0;
    mask16 inside[MAP_VECTORS], own[MAP_VECTORS]; // of the maps' columns
    for (int v = 0; v < MAP_VECTORS; v++) {
        const real16 x = IOTA + (real)(x0 - RADIUS + 16 * v);
        inside[v] = TO_MASK(x >= 0) & TO_MASK(x < (real)width);
        own[v] = TO_MASK(x >= (real)x0) & TO_MASK(x < (real)x_end);
    }
    real16 sums[TAPS * MAP_VECTORS * MEANS], map_sums[TAPS * VECTORS * MAPS];
    real16 l1 = 0, total = 0;
    for (int y = y0 - 2 * RADIUS; y < y_end + 2 * RADIUS; y++) {
        const int soon = min(y + ROWS_AHEAD, height - 1), out_soon = soon - 2 * RADIUS;
        if (soon >= 0) {
            PREFETCH_SPAN(image + (long)soon * width + wide_x0, wide_x_end - wide_x0);
            PREFETCH_SPAN(photo + (long)soon * width + wide_x0, wide_x_end - wide_x0);
        }
        if (out_soon >= y0)
            PREFETCH_SPAN(grad_image + (long)out_soon * width + x0, x_end - x0);
        real16 *newest = sums + SLOT(y) * (MAP_VECTORS * MEANS);
        if (y < 0 || y >= height) {
            for (int i = 0; i < MAP_VECTORS * MEANS; i++)
                newest[i] = 0;
        } else {
            real16 xs[IMAGE_VECTORS], ys[IMAGE_VECTORS];
            const int first = x0 - 2 * RADIUS;
            load_image(image + (long)y * width, first, IMAGE_VECTORS, width, padded[0], xs);
            load_photo(photo + (long)y * width, first, IMAGE_VECTORS, width, padded[1], ys);
            MASK_ROW(y, first, IMAGE_VECTORS, padded[MASKED ? 4 : 0]);
            for (int v = 0; v < IMAGE_VECTORS; v++) {
                xs[v] = COUNTED(v, xs[v]);
                ys[v] = COUNTED(v, ys[v]);
            }
            for (int v = 0; v < MAP_VECTORS; v++) {
                const real16 x = xs[v], y = ys[v], next_x = xs[v + 1], next_y = ys[v + 1];
                newest[MEANS * v] = window_across(x, next_x);
                newest[MEANS * v + 1] = window_across(y, next_y);
                newest[MEANS * v + 2] =
                    window_across(x * x + y * y, next_x * next_x + next_y * next_y);
                newest[MEANS * v + 3] = window_across(x * y, next_x * next_y);
            }
        }
        const int map_y = y - RADIUS;
        if (map_y < y0 - RADIUS)
            continue;
        real16 *newest_map = map_sums + SLOT(map_y) * (VECTORS * MAPS);
        if (map_y < 0 || map_y >= height) {
            for (int i = 0; i < VECTORS * MAPS; i++)
                newest_map[i] = 0;
        } else {
            LAST_ROWS(rows, sums, MAP_VECTORS * MEANS, y);
            real16 by[MAPS][MAP_VECTORS];
            real16 row_total = 0;
            MASK_ROW(map_y, x0 - RADIUS, MAP_VECTORS, padded[MASKED ? 5 : 0]);
            for (int v = 0; v < MAP_VECTORS; v++) {
                real16 by_x, by_xx, by_xy;
                const real16 value = ssim(
                    window_down(rows, MEANS * v), window_down(rows, MEANS * v + 1),
                    window_down(rows, MEANS * v + 2), window_down(rows, MEANS * v + 3), &by_x,
                    &by_xx, &by_xy);
                by[0][v] = COUNTED(v, select((real16)0, by_x, inside[v]));
                by[1][v] = COUNTED(v, select((real16)0, by_xx, inside[v]));
                by[2][v] = COUNTED(v, select((real16)0, by_xy, inside[v]));
                row_total += select((real16)0, COUNTED_ELSE(v, value, 1), own[v]);
            }
            if (map_y >= y0 && map_y < y_end)
                total += row_total;
            for (int v = 0; v < VECTORS; v++)
                for (int m = 0; m < MAPS; m++)
                    newest_map[MAPS * v + m] = window_across(by[m][v], by[m][v + 1]);
        }
        const int out = map_y - RADIUS;
        if (out < y0)
            continue;
        LAST_ROWS(rows, map_sums, VECTORS * MAPS, map_y);
        real16 xs[VECTORS], ys[VECTORS];
        load_image(image + (long)out * width, x0, VECTORS, width, padded[2], xs);
        load_photo(photo + (long)out * width, x0, VECTORS, width, padded[3], ys);
        MASK_ROW(out, x0, VECTORS, padded[MASKED ? 6 : 0]);
        for (int v = 0; v < VECTORS; v++) {
            xs[v] = COUNTED(v, xs[v]);
            ys[v] = COUNTED(v, ys[v]);
            const real16 by_x = window_down(rows, MAPS * v);
            const real16 by_xx = window_down(rows, MAPS * v + 1);
            const real16 by_xy = window_down(rows, MAPS * v + 2), difference = xs[v] - ys[v];
            l1 += fabs(difference); // zero outside the image
            const int first = x0 + 16 * v;
            store_row(COUNTED(v, l1_scale * sign(difference) +
                                     ssim_scale * (by_x + 2 * xs[v] * by_xx + ys[v] * by_xy)),
                      grad_image + (long)out * width + first, width - first);
        }
    }
    partials[2 * get_global_id(0)] = sum16(l1);
    partials[2 * get_global_id(0) + 1] = sum16(total);
}
