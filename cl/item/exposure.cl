// Item form of exposure.cl (see there): a work-item walks blocks, 16 pixels at a time.
DEFINE_PIXELS(pixels16, real16, vload16, vstore16)

__kernel void exposure_adjoint(uint pixels, uint view, uint blocks,
                               __global const real *restrict transforms,
                               __global const real *restrict image,
                               __global const real *restrict grad,
                               __global real *restrict grad_image, __global real *restrict partials)
{
    real e[TRANSFORM_REALS];
    for (int k = 0; k < TRANSFORM_REALS; k++)
        e[k] = transforms[view * TRANSFORM_REALS + k];
    FOR_EACH(block, blocks) {
        real16 wide[TRANSFORM_REALS];
        real rest[TRANSFORM_REALS];
        for (int k = 0; k < TRANSFORM_REALS; k++)
            wide[k] = rest[k] = 0;
        ulong p = block * EXPOSURE_BLOCK;
        const ulong end = min(p + EXPOSURE_BLOCK, (ulong)pixels);
        for (; p + 16 <= end; p += 16)
            pixels16(pixels, e, image + p, grad + p, grad_image + p, wide);
        for (; p < end; p++)
            pixels1(pixels, e, image + p, grad + p, grad_image + p, rest);
        for (int k = 0; k < TRANSFORM_REALS; k++)
            partials[block * TRANSFORM_REALS + k] = sum16(wide[k]) + rest[k];
    }
}
