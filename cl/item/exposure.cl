// Item form of exposure.cl (see there): a work-item walks blocks, 16 pixels at a time.
DEFINE_PIXELS(16, real16, vload16, vstore16)

__kernel void exposure_adjoint(EXPOSURE_ADJOINT_ARGUMENTS)
{
    Response response;
    LOAD_RESPONSE(response);
    FOR_EACH(block, blocks) {
        real16 wide[RESPONSE_TERMS];
        real rest[RESPONSE_TERMS];
        for (int k = 0; k < RESPONSE_TERMS; k++)
            wide[k] = rest[k] = 0;
        ulong p = block * EXPOSURE_BLOCK;
        const ulong end = min(p + EXPOSURE_BLOCK, (ulong)pixels);
        for (; p + 16 <= end; p += 16) { // which may lie in several rows
            const real16 along = IOTA + (p % width + (real)0.5), rows = floor(along / (real)width);
            const real16 u = RADIUS(16, response, along - rows * (real)width,
                                    rows + (p / width + (real)0.5));
            pixels16(pixels, p, &response, u, image, grad, grad_image, wide);
        }
        for (; p < end; p++)
            pixels1(pixels, p, &response, RADIUS_OF_ONE(p), image, grad, grad_image, rest);
        for (int k = 0; k < RESPONSE_TERMS; k++)
            partials[block * RESPONSE_TERMS + k] = sum16(wide[k]) + rest[k];
    }
}
