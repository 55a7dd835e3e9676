// Item form of image_loss.cl (see there): a work-item owns 16 columns by `strip` rows of a channel.

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

// Horizontal window sums of one row: every tap adds weight * (x, y, x^2, y^2, x y).
#define MOMENTS(LOAD_X, LOAD_Y)                                                                    \
    for (int k = 0; k < TAPS; k++) {                                                               \
        const real16 x = LOAD_X, y = LOAD_Y, wx = WINDOW[k] * x, wy = WINDOW[k] * y;               \
        sums[0] += wx;                                                                             \
        sums[1] += wy;                                                                             \
        sums[2] += wx * x;                                                                         \
        sums[3] += wy * y;                                                                         \
        sums[4] += wx * y;                                                                         \
    }

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void image_loss(int width, int height, int strip, __global const real *restrict image,
                __global const uchar *restrict photo, __global real *restrict maps,
                __global real *restrict partials)
{
    const int across = (width + 15) / 16, down = (height + strip - 1) / strip;
    const int item = get_global_id(0), channel = item / (across * down);
    const int x0 = item % across * 16, y0 = item / across % down * strip;
    const long plane = (long)width * height;
    const int columns = min(16, width - x0), y_end = min(y0 + strip, height);
    const bool interior = x0 >= RADIUS && x0 + 16 + RADIUS <= width;
    real16 ring[TAPS][5];
    real l1 = 0, total = 0;
    for (int y = y0 - RADIUS; y < y_end + RADIUS; y++) {
        real16 *sums = ring[(y + TAPS) % TAPS];
        for (int m = 0; m < 5; m++)
            sums[m] = 0;
        if (y >= 0 && y < height) {
            __global const real *image_row = image + channel * plane + (long)y * width;
            __global const uchar *photo_row = photo + channel * plane + (long)y * width;
            if (interior) {
                image_row += x0 - RADIUS;
                photo_row += x0 - RADIUS;
                MOMENTS(vload16(0, image_row + k), photo16(photo_row + k))
            } else {
                real xs[PADDED], ys[PADDED];
                load_padded(image_row, x0, width, xs);
                load_padded_photo(photo_row, x0, width, ys);
                MOMENTS(vload16(0, xs + k), vload16(0, ys + k))
            }
        }
        const int out = y - RADIUS; // the row whose window is now complete
        if (out < y0)
            continue;
        real16 mean[5] = {0, 0, 0, 0, 0};
        for (int k = 0; k < TAPS; k++) {
            const real16 *row = ring[(out - RADIUS + k + TAPS) % TAPS];
            for (int m = 0; m < 5; m++)
                mean[m] += WINDOW[k] * row[m];
        }
        real16 by[3];
        const real16 value =
            ssim(mean[0], mean[1], mean[2], mean[3], mean[4], &by[0], &by[1], &by[2]);
        const long pixel = (long)out * width + x0;
        if (columns == 16) {
            for (int m = 0; m < 3; m++)
                vstore16(by[m], 0, maps + (channel * 3 + m) * plane + pixel);
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
                    maps[(channel * 3 + m) * plane + pixel + i] = values[m][i];
                total += values[3][i];
                l1 += fabs(image[channel * plane + pixel + i] -
                           photo[channel * plane + pixel + i] * (real)(1.0 / 255));
            }
        }
    }
    partials[2 * item] = l1;
    partials[2 * item + 1] = total;
}

#define CONVOLVE(M, LOAD)                                                                          \
    for (int k = 0; k < TAPS; k++)                                                                 \
        sums[M] += WINDOW[k] * LOAD;

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void image_loss_adjoint(int width, int height, int strip, real l1_scale, real ssim_scale,
                        __global const real *restrict image, __global const uchar *restrict photo,
                        __global const real *restrict maps, __global real *restrict grad_image)
{
    const int across = (width + 15) / 16, down = (height + strip - 1) / strip;
    const int item = get_global_id(0), channel = item / (across * down);
    const int x0 = item % across * 16, y0 = item / across % down * strip;
    const long plane = (long)width * height;
    const int columns = min(16, width - x0), y_end = min(y0 + strip, height);
    const bool interior = x0 >= RADIUS && x0 + 16 + RADIUS <= width;
    real16 ring[TAPS][3];
    for (int y = y0 - RADIUS; y < y_end + RADIUS; y++) {
        real16 *sums = ring[(y + TAPS) % TAPS];
        for (int m = 0; m < 3; m++) {
            sums[m] = 0;
            if (y < 0 || y >= height)
                continue;
            __global const real *row = maps + (channel * 3 + m) * plane + (long)y * width;
            if (interior) {
                row += x0 - RADIUS;
                CONVOLVE(m, vload16(0, row + k))
            } else {
                real values[PADDED];
                load_padded(row, x0, width, values);
                CONVOLVE(m, vload16(0, values + k))
            }
        }
        const int out = y - RADIUS;
        if (out < y0)
            continue;
        real16 by[3] = {0, 0, 0};
        for (int k = 0; k < TAPS; k++) {
            const real16 *row = ring[(out - RADIUS + k + TAPS) % TAPS];
            for (int m = 0; m < 3; m++)
                by[m] += WINDOW[k] * row[m];
        }
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
                         ssim_scale * (by[0] + 2 * x * by[1] + photo_value * by[2]);
        if (columns == 16) {
            vstore16(g, 0, grad_image + pixel);
        } else {
            vstore16(g, 0, values);
            for (int i = 0; i < columns; i++)
                grad_image[pixel + i] = values[i];
        }
    }
}
