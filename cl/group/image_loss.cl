// Group form of image_loss.cl (see there): a group owns a tile of one channel, and loads its halo.
#define GROUP (TILE * TILE)
#include "group.h"
DEFINE_GROUP_SUM(group_sum, real)
#define WIDE (TILE + 2 * RADIUS)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void image_loss(int width, int height, __global const real *restrict image,
                __global const uchar *restrict photo, __global real *restrict partials,
                __global real *restrict maps)
{
    __local real xs[WIDE * WIDE], ys[WIDE * WIDE], rows[MEANS][WIDE * TILE], scratch[GROUP];
    const int group = get_group_id(0), lane = get_local_id(0);
    LOCATE_PART(group, TILE, TILE);
    FOR_GROUP(i, WIDE * WIDE) {
        const int x = x0 - RADIUS + (int)i % WIDE, y = y0 - RADIUS + (int)i / WIDE;
        const bool inside = x >= 0 && y >= 0 && x < width && y < height;
        const long pixel = channel * plane + (long)y * width + x;
        xs[i] = inside ? image[pixel] : 0;
        ys[i] = inside ? photo[pixel] * (real)(1.0 / 255) : 0;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    FOR_GROUP(i, WIDE * TILE) {
        const int from = i / TILE * WIDE + i % TILE;
        real sums[MEANS] = {0, 0, 0, 0};
        for (int k = 0; k < TAPS; k++) {
            const real x = xs[from + k], y = ys[from + k], wx = WINDOW[k] * x, wy = WINDOW[k] * y;
            sums[0] += wx;
            sums[1] += wy;
            sums[2] += wx * x + wy * y;
            sums[3] += wx * y;
        }
        for (int m = 0; m < MEANS; m++)
            rows[m][i] = sums[m];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const int x = x0 + lane % TILE, y = y0 + lane / TILE;
    const bool inside = x < width && y < height;
    real mean[MEANS] = {0, 0, 0, 0}, by[3];
    for (int k = 0; k < TAPS; k++)
        for (int m = 0; m < MEANS; m++)
            mean[m] += WINDOW[k] * rows[m][(lane / TILE + k) * TILE + lane % TILE];
    const real value = ssim(mean[0], mean[1], mean[2], mean[3], &by[0], &by[1], &by[2]);
    const int centre = (lane / TILE + RADIUS) * WIDE + lane % TILE + RADIUS;
    if (inside)
        for (int m = 0; m < 3; m++)
            maps[(channel * 3 + m) * plane + (long)y * width + x] = by[m];
    const real l1_sum = group_sum(inside ? fabs(xs[centre] - ys[centre]) : 0, scratch);
    const real ssim_sum = group_sum(inside ? value : 0, scratch);
    if (lane == 0) {
        partials[2 * group] = l1_sum;
        partials[2 * group + 1] = ssim_sum;
    }
}

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void image_loss_adjoint(int width, int height, __global const real *restrict image,
                        __global const uchar *restrict photo, __global const real *restrict maps,
                        real l1_scale, real ssim_scale, __global real *restrict grad_image)
{
    __local real wide[3][WIDE * WIDE], rows[3][WIDE * TILE];
    const int group = get_group_id(0), lane = get_local_id(0);
    LOCATE_PART(group, TILE, TILE);
    FOR_GROUP(i, WIDE * WIDE) {
        const int x = x0 - RADIUS + (int)i % WIDE, y = y0 - RADIUS + (int)i / WIDE;
        const bool inside = x >= 0 && y >= 0 && x < width && y < height;
        for (int m = 0; m < 3; m++)
            wide[m][i] =
                inside ? maps[(channel * 3 + m) * plane + (long)y * width + x] : 0;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    FOR_GROUP(i, WIDE * TILE) {
        const int from = i / TILE * WIDE + i % TILE;
        for (int m = 0; m < 3; m++) {
            real sum = 0;
            for (int k = 0; k < TAPS; k++)
                sum += WINDOW[k] * wide[m][from + k];
            rows[m][i] = sum;
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    const int x = x0 + lane % TILE, y = y0 + lane / TILE;
    if (x < width && y < height) {
        real by[3] = {0, 0, 0};
        for (int k = 0; k < TAPS; k++)
            for (int m = 0; m < 3; m++)
                by[m] += WINDOW[k] * rows[m][(lane / TILE + k) * TILE + lane % TILE];
        const long pixel = channel * plane + (long)y * width + x;
        const real value = image[pixel], photo_value = photo[pixel] * (real)(1.0 / 255);
        grad_image[pixel] = l1_scale * sign(value - photo_value) +
                            ssim_scale * (by[0] + 2 * value * by[1] + photo_value * by[2]);
    }
}
