// Item form of image_loss.cl (see there): a work-item slides down a strip of 16 columns and
// `strip` rows of a channel, with a ring of the last 11 rows.

// 16 + 2 RADIUS values of one row around a strip; zeros outside the image.
#define PADDED (16 + 2 * RADIUS)

inline void load_padded(__global const real *row, int x0, int width, real *values)
{
    for (int i = 0; i < PADDED; i++) {
        const int x = x0 - RADIUS + i;
        values[i] = x >= 0 && x < width ? row[x] : 0;
    }
}

inline void load_padded_photo(__global const uchar *row, int x0, int width, real *values)
{
    for (int i = 0; i < PADDED; i++) {
        const int x = x0 - RADIUS + i;
        values[i] = (x >= 0 && x < width ? row[x] : 0) * (real)(1.0 / 255);
    }
}

inline real16 photo16(__global const uchar *values)
{
    return convert_real16(vload16(0, values)) * (real)(1.0 / 255);
}

// Every tap spelled out, so that sums stay in registers and weights are constants.
#define EACH_TAP(TAP)                                                                              \
    TAP(0) TAP(1) TAP(2) TAP(3) TAP(4) TAP(5) TAP(6) TAP(7) TAP(8) TAP(9) TAP(10)

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void image_loss(int width, int height, int strip, int first_channel,
                __global const real *restrict image, __global const uchar *restrict photo,
                __global real *restrict maps, __global real *restrict partials)
{
    const int item = get_global_id(0);
    LOCATE_PART(item, 16, strip);
    const int columns = min(16, width - x0), y_end = min(y0 + strip, height);
    const bool interior = x0 >= RADIUS && x0 + 16 + RADIUS <= width;
    real16 ring[TAPS][MEANS];
    real l1 = 0, total = 0;
    for (int y = y0 - RADIUS; y < y_end + RADIUS; y++) {
        real16 s0 = 0, s1 = 0, s2 = 0, s3 = 0;
        if (y >= 0 && y < height) {
            __global const real *image_row = image + channel * plane + (long)y * width;
            __global const uchar *photo_row = photo + channel * plane + (long)y * width;
#define HORIZONTAL(K)                                                                              \
    {                                                                                              \
        const real16 x = LOAD_X(K), y = LOAD_Y(K), wx = WINDOW[K] * x, wy = WINDOW[K] * y;         \
        s0 += wx;                                                                                  \
        s1 += wy;                                                                                  \
        s2 += wx * x;                                                                              \
        s2 += wy * y;                                                                              \
        s3 += wx * y;                                                                              \
    }
            if (interior) {
                image_row += x0 - RADIUS;
                photo_row += x0 - RADIUS;
#define LOAD_X(K) vload16(0, image_row + K)
#define LOAD_Y(K) photo16(photo_row + K)
                EACH_TAP(HORIZONTAL)
#undef LOAD_X
#undef LOAD_Y
            } else {
                real xs[PADDED], ys[PADDED];
                load_padded(image_row, x0, width, xs);
                load_padded_photo(photo_row, x0, width, ys);
#define LOAD_X(K) vload16(0, xs + K)
#define LOAD_Y(K) vload16(0, ys + K)
                EACH_TAP(HORIZONTAL)
            }
        }
        real16 *newest = ring[(y + TAPS) % TAPS];
        newest[0] = s0;
        newest[1] = s1;
        newest[2] = s2;
        newest[3] = s3;
        const int out = y - RADIUS; // the row whose window is now complete
        if (out < y0)
            continue;
        real16 x = 0, y_mean = 0, squares = 0, xy = 0;
#define VERTICAL(K)                                                                                \
    {                                                                                              \
        const real16 *row = ring[(out - RADIUS + K + TAPS) % TAPS];                                \
        x += WINDOW[K] * row[0];                                                                   \
        y_mean += WINDOW[K] * row[1];                                                              \
        squares += WINDOW[K] * row[2];                                                             \
        xy += WINDOW[K] * row[3];                                                                  \
    }
        EACH_TAP(VERTICAL)
#undef VERTICAL
        real16 by[3];
        const real16 value = ssim(x, y_mean, squares, xy, &by[0], &by[1], &by[2]);
        const long pixel = (long)out * width + x0;
        if (columns == 16) {
            for (int m = 0; m < 3; m++)
                vstore16(by[m], 0, maps + (place * 3 + m) * plane + pixel);
            total += sum16(value);
            l1 += sum16(fabs(vload16(0, image + channel * plane + pixel) -
                             photo16(photo + channel * plane + pixel)));
        } else {
            real values[4][16];
            for (int m = 0; m < 3; m++)
                vstore16(by[m], 0, values[m]);
            vstore16(value, 0, values[3]);
            for (int i = 0; i < columns; i++) {
                for (int m = 0; m < 3; m++)
                    maps[(place * 3 + m) * plane + pixel + i] = values[m][i];
                total += values[3][i];
                l1 += fabs(image[channel * plane + pixel + i] -
                           photo[channel * plane + pixel + i] * (real)(1.0 / 255));
            }
        }
    }
    const int own = first_channel * across * down + item;
    partials[2 * own] = l1;
    partials[2 * own + 1] = total;
}

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void image_loss_adjoint(int width, int height, int strip, int first_channel, real l1_scale,
                        real ssim_scale,
                        __global const real *restrict image, __global const uchar *restrict photo,
                        __global const real *restrict maps, __global real *restrict grad_image)
{
    const int item = get_global_id(0);
    LOCATE_PART(item, 16, strip);
    const int columns = min(16, width - x0), y_end = min(y0 + strip, height);
    const bool interior = x0 >= RADIUS && x0 + 16 + RADIUS <= width;
    real16 ring[TAPS][3];
    for (int y = y0 - RADIUS; y < y_end + RADIUS; y++) {
        real16 s0 = 0, s1 = 0, s2 = 0;
        if (y >= 0 && y < height) {
            __global const real *row = maps + place * 3 * plane + (long)y * width;
#define CONVOLVE(K)                                                                                \
    s0 += WINDOW[K] * LOAD(0, K);                                                                  \
    s1 += WINDOW[K] * LOAD(1, K);                                                                  \
    s2 += WINDOW[K] * LOAD(2, K);
            if (interior) {
                row += x0 - RADIUS;
#define LOAD(M, K) vload16(0, row + M * plane + K)
                EACH_TAP(CONVOLVE)
#undef LOAD
            } else {
                real values[3][PADDED];
                for (int m = 0; m < 3; m++)
                    load_padded(row + m * plane, x0, width, values[m]);
#define LOAD(M, K) vload16(0, values[M] + K)
                EACH_TAP(CONVOLVE)
            }
        }
        real16 *newest = ring[(y + TAPS) % TAPS];
        newest[0] = s0;
        newest[1] = s1;
        newest[2] = s2;
        const int out = y - RADIUS;
        if (out < y0)
            continue;
        real16 by_x = 0, by_xx = 0, by_xy = 0;
#define VERTICAL(K)                                                                                \
    {                                                                                              \
        const real16 *row = ring[(out - RADIUS + K + TAPS) % TAPS];                                \
        by_x += WINDOW[K] * row[0];                                                                \
        by_xx += WINDOW[K] * row[1];                                                               \
        by_xy += WINDOW[K] * row[2];                                                               \
    }
        EACH_TAP(VERTICAL)
        const long pixel = channel * plane + (long)out * width + x0;
        real values[16];
        real16 x, photo_value;
        if (columns == 16) {
            x = vload16(0, image + pixel);
            photo_value = photo16(photo + pixel);
        } else {
            real ys[16];
            for (int i = 0; i < 16; i++) {
                values[i] = i < columns ? image[pixel + i] : 0;
                ys[i] = i < columns ? photo[pixel + i] * (real)(1.0 / 255) : 0;
            }
            x = vload16(0, values);
            photo_value = vload16(0, ys);
        }
        const real16 g = l1_scale * sign(x - photo_value) +
                         ssim_scale * (by_x + 2 * x * by_xx + photo_value * by_xy);
        if (columns == 16) {
            vstore16(g, 0, grad_image + pixel);
        } else {
            vstore16(g, 0, values);
            for (int i = 0; i < columns; i++)
                grad_image[pixel + i] = values[i];
        }
    }
}
