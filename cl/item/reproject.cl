// Item form of reproject.cl (see there): a work-item owns a row.
__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void reproject(REPROJECT_ARGUMENTS)
{
    const int row = get_global_id(0);
    real2 sum = (real2)(0);
    for (int x = 0; x < width; x++) {
        const long pixel = (long)row * width + x;
        real2 grads;
        sum += reproject_pixel(
            x, row, width, height, neighbour_width, neighbour_height, depth[pixel],
            transmittance[pixel], photo, neighbour, geometries + GEOMETRY_REALS * (ulong)pair,
            colours + TRANSFORM_REALS * (ulong)pair, &grads);
        grad_depth[pixel] = grads.x;
        grad_transmittance[pixel] = grads.y;
    }
    vstore2(sum, row, partials);
}
