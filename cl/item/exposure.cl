// Item form of exposure.cl (see there): a work-item walks blocks, 16 pixels at a time.
DEFINE_RADIUS(radius16, real16)
DEFINE_PIXELS(pixels16, real16, vload16, vstore16, SIXTEEN_BYTES)

// Those of the 16 pixels from p on, which may lie in several rows.
inline real16 radius_of16(__global const real *camera, __global const real *lens, ulong p,
                          uint width)
{
    if (!WITH_VIGNETTING)
        return 0;
    const real16 along = IOTA + (p % width + (real)0.5), rows = floor(along / (real)width);
    return radius16(camera, lens, along - rows * (real)width, rows + (p / width + (real)0.5));
}

__kernel void exposure_adjoint(uint pixels, uint width, uint view, uint blocks,
                               __global const real *restrict camera,
                               __global const real *restrict transforms,
                               __global const uint *restrict lens_of,
                               __global const real *restrict lenses,
                               __global const real *restrict image,
                               __global const real *restrict grad,
                               __global const uchar *restrict layers,
                               __global real *restrict grad_image, __global real *restrict partials)
{
    __global const real *lens = lenses + lens_of[view] * VIGNETTING_REALS;
    real e[TRANSFORM_REALS];
    for (int k = 0; k < TRANSFORM_REALS; k++)
        e[k] = transforms[view * TRANSFORM_REALS + k];
    FOR_EACH(block, blocks) {
        real16 wide[EXPOSURE_SUMS];
        real rest[EXPOSURE_SUMS];
        for (int k = 0; k < EXPOSURE_SUMS; k++)
            wide[k] = rest[k] = 0;
        ulong p = block * EXPOSURE_BLOCK;
        const ulong end = min(p + EXPOSURE_BLOCK, (ulong)pixels);
        for (; p + 16 <= end; p += 16)
            pixels16(pixels, e, lens, radius_of16(camera, lens, p, width), image + p,
                     grad + p, layers + p, grad_image + p, wide);
        for (; p < end; p++)
            pixels1(pixels, e, lens, radius_of1(camera, lens, p, width), image + p,
                    grad + p, layers + p, grad_image + p, rest);
        for (int k = 0; k < EXPOSURE_SUMS; k++)
            partials[block * EXPOSURE_SUMS + k] = sum16(wide[k]) + rest[k];
    }
}
