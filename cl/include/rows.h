// Sixteen gaussians at once, a vector a column, for the item form. Rows past `number`, the end of
// an array, are zeros.
inline void load_rows3(__global const real *rows, uint number, real16 *x, real16 *y, real16 *z)
{
    real16 a, b, c;
    if (number >= 16) {
        a = vload16(0, rows);
        b = vload16(1, rows);
        c = vload16(2, rows);
    } else {
        real values[48];
        for (uint i = 0; i < 48; i++)
            values[i] = i < 3 * number ? rows[i] : 0;
        a = vload16(0, values);
        b = vload16(1, values);
        c = vload16(2, values);
    }
    *x = (real16)(a.s0, a.s3, a.s6, a.s9, a.sc, a.sf, b.s2, b.s5, b.s8, b.sb, b.se, c.s1, c.s4,
                  c.s7, c.sa, c.sd);
    *y = (real16)(a.s1, a.s4, a.s7, a.sa, a.sd, b.s0, b.s3, b.s6, b.s9, b.sc, b.sf, c.s2, c.s5,
                  c.s8, c.sb, c.se);
    *z = (real16)(a.s2, a.s5, a.s8, a.sb, a.se, b.s1, b.s4, b.s7, b.sa, b.sd, c.s0, c.s3, c.s6,
                  c.s9, c.sc, c.sf);
}

// Positions in the camera's frame.
inline void load_in_camera(__global const real *camera, __global const real *positions,
                           uint number, real16 *x, real16 *y, real16 *z)
{
    __global const real *r = camera + CAMERA_ROTATION, *t = camera + CAMERA_TRANSLATION;
    real16 world_x, world_y, world_z;
    load_rows3(positions, number, &world_x, &world_y, &world_z);
    *x = r[0] * world_x + r[1] * world_y + r[2] * world_z + t[0];
    *y = r[3] * world_x + r[4] * world_y + r[5] * world_z + t[1];
    *z = r[6] * world_x + r[7] * world_y + r[8] * world_z + t[2];
}

// The largest logarithm of each gaussian's scales.
inline real16 load_largest(__global const real *log_scales, uint number)
{
    real16 x, y, z;
    load_rows3(log_scales, number, &x, &y, &z);
    return max(x, max(y, z));
}

// List those of the `number` rows from `first` on where `mask` holds; returns how many. The list
// has room for 16.
inline uint list_rows(mask16 mask, uint first, uint number, uint *list)
{
    uint listed = 0;
    mask &= TO_MASK(IOTA < (real)number);
#define LIST_ROW(K)                                                                                \
    list[listed] = first + 0x##K;                                                                  \
    listed += mask.s##K != 0;
    LIST_ROW(0) LIST_ROW(1) LIST_ROW(2) LIST_ROW(3) LIST_ROW(4) LIST_ROW(5) LIST_ROW(6) LIST_ROW(7)
    LIST_ROW(8) LIST_ROW(9) LIST_ROW(a) LIST_ROW(b) LIST_ROW(c) LIST_ROW(d) LIST_ROW(e) LIST_ROW(f)
#undef LIST_ROW
    return listed;
}
