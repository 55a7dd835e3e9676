// Item form of contribution.cl (see there): a work-item owns a tile; a row of 16 pixels is one
// vector.

__kernel __attribute__((reqd_work_group_size(1, 1, 1)))
void contribution(int width, int height, int tiles_x, int first_tile,
                  __global const uint *restrict ranges, __global const uint *restrict sorted_splats,
                  __global const uint *restrict emission_indices,
                  __global const real *restrict splats,
                  __global const int *restrict last_contributor,
                  __global const real *restrict weights, __global real *restrict sums)
{
    const int tile = get_global_id(0), place = first_tile + tile;
    const int x0 = place % tiles_x * TILE, y0 = place / tiles_x * TILE;
    const int columns = min(TILE, width - x0), rows = min(TILE, height - y0);
    const int begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const real16 x = IOTA + (real)(x0 + 0.5);
    const real first_y = y0 + 0.5;
    real16 t[TILE], weight[TILE];
    mask16 latest[TILE];
    for (int r = 0; r < rows; r++) {
        real values[16];
        int indices[16];
        for (int i = 0; i < 16; i++) {
            const long pixel = (long)(y0 + r) * width + x0 + i;
            values[i] = i < columns ? weights[pixel] : 0;
            indices[i] = i < columns ? last_contributor[pixel] : -1;
        }
        t[r] = 1;
        weight[r] = vload16(0, values);
        latest[r] = convert_mask16(vload16(0, indices));
    }
    for (int i = begin; i < end; i++) {
        SPLAT_IN_ROWS(sorted_splats[i]);
        const real16 zero = 0;
        real16 s_pixels = 0, s_weight = 0, s_weighted = 0, s_distance = 0;
        for (int r = 0; r < rows; r++) {
            const real dy = first_y + r - mean_y;
            const real16 excess = excess_x + dy * (c * dy - shear);
            const mask16 live = TO_MASK(excess >= 0) & TO_MASK(latest[r] >= (mask16)i);
            if (!any16(live))
                continue;
            const real16 w = select(zero, cut_alpha(alpha_of(excess)) * t[r], live);
            t[r] -= w;
            s_pixels += select(zero, (real16)1, live);
            s_weight += w;
            s_weighted += select(zero, w * weight[r], live); // a weight may be nan elsewhere
            s_distance += select(zero, sqrt(dx * dx + dy * dy), live);
        }
        vstore4((real4)(sum16(s_pixels), sum16(s_weight), sum16(s_weighted), sum16(s_distance)),
                emission_indices[i], sums);
    }
}
