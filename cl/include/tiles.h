// Which tiles a splat touches: the exact ellipse at its opacity-aware cutoff, by rows of tiles.
// Count and emit both walk this, so that they cannot disagree on the rule; nor on a bit of it, as
// no compiler may contract operations in one of them only.
#pragma OPENCL FP_CONTRACT OFF

typedef struct {
    real mean_x, mean_y, shear, half_width, extent_y;
} Ellipse;

// shape, conic: the first eight columns of a splat.
INLINE Ellipse ellipse_from(real4 shape, real4 conic)
{
    // a hair larger, so that rounding here never drops a pixel that blending would draw
    const real cutoff = shape.w * 1.001 + 0.001;
    Ellipse e;
    e.mean_x = shape.x;
    e.mean_y = shape.y;
    e.shear = conic.y / conic.x;
    e.half_width = sqrt(cutoff / conic.x); // of the chord through the mean
    e.extent_y = conic.w * 1.001 + 0.01;
    return e;
}

INLINE Ellipse ellipse_of(__global const real *splat)
{
    return ellipse_from(vload4(0, splat), vload4(1, splat));
}

// Clamp in real before converting: a huge ellipse does not fit an int.
inline int to_tile(real value, int last)
{
    return (int)clamp(value, (real)-1, (real)(last + 1));
}

// Tile rows [*begin, *end) whose pixel centres the ellipse can reach.
INLINE void tile_rows(Ellipse e, int tiles_y, int *begin, int *end)
{
    *begin = max(0, to_tile(ceil((e.mean_y - e.extent_y + 0.5) / TILE) - 1, tiles_y));
    *end = min(tiles_y, to_tile(floor((e.mean_y + e.extent_y - 0.5) / TILE) + 1, tiles_y));
}

// The ellipse's ends, relative to its mean, in the strip between two rows of pixel centres, which
// it must reach: the right one is at its rightmost point where that lies inside, else on the nearer
// edge.
INLINE void strip_ends(Ellipse e, real first_y, real last_y, real *left, real *right)
{
    const real slope = e.shear * e.extent_y;
#if BOX_TILES // all tiles of the ellipse's bounding box: its cost: docs/evidence/numerics.md
    *right = sqrt(slope * slope + e.half_width * e.half_width);
    *left = -*right;
#else
    const real low = (first_y - e.mean_y) / e.extent_y;
    const real high = (last_y - e.mean_y) / e.extent_y;
    const real rightmost = -slope / sqrt(slope * slope + e.half_width * e.half_width);
    const real u_right = clamp(rightmost, max(low, (real)-1), min(high, (real)1));
    const real u_left = clamp(-rightmost, max(low, (real)-1), min(high, (real)1));
    *right = -slope * u_right + e.half_width * sqrt(max((real)0, 1 - u_right * u_right));
    *left = -slope * u_left - e.half_width * sqrt(max((real)0, 1 - u_left * u_left));
#endif
}

// Tile columns [*begin, *end) of one tile row.
INLINE void tile_columns(Ellipse e, int row, int tiles_x, int *begin, int *end)
{
    real left, right;
    strip_ends(e, row * TILE + 0.5, row * TILE + TILE - 0.5, &left, &right);
    *begin = max(0, to_tile(ceil((e.mean_x + left - 0.01 + 0.5) / TILE) - 1, tiles_x));
    *end = min(tiles_x, to_tile(floor((e.mean_x + right + 0.01 - 0.5) / TILE) + 1, tiles_x));
}
#pragma OPENCL FP_CONTRACT ON
