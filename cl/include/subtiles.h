// Sub-tiles: a tile's pixels in blocks of WAVE, 8 wide, so that the lanes of a wave skip together
// what a splat does not reach. They are numbered row by row; a pixel's slot is WAVE times its
// sub-tile's number plus its place in it, row by row too.
#include "tiles.h"
#define PIXELS (TILE * TILE)
#define SUBTILES (PIXELS / WAVE)
#define SUBTILES_X (TILE / 8)
#define SUBTILE_ROWS (WAVE / 8)
#ifndef SUBTILE_MASK
#define SUBTILE_MASK 1
#endif

inline int slot_column(int slot)
{
    return slot / WAVE % SUBTILES_X * 8 + slot % 8;
}

inline int slot_row(int slot)
{
    return slot / WAVE / SUBTILES_X * SUBTILE_ROWS + slot % WAVE / 8;
}

// Bit i is set where the ellipse may reach pixel centres of sub-tile i of the tile with its first
// pixel at (x0, y0).
inline uint reached_subtiles(Ellipse e, int x0, int y0)
{
#if !SUBTILE_MASK
    return (1u << SUBTILES) - 1;
#endif
    uint reached = 0;
#pragma unroll 1
    for (int row = 0; row < TILE / SUBTILE_ROWS; row++) {
        const real first_y = y0 + row * SUBTILE_ROWS + 0.5, last_y = first_y + (SUBTILE_ROWS - 1);
        if (first_y <= e.mean_y + e.extent_y && last_y >= e.mean_y - e.extent_y) {
            real left, right;
            strip_ends(e, first_y, last_y, &left, &right);
            for (int column = 0; column < SUBTILES_X; column++) {
                const real first_x = x0 + column * 8 + 0.5;
                if (first_x <= e.mean_x + right + 0.01 && first_x + 7 >= e.mean_x + left - 0.01)
                    reached |= 1u << (row * SUBTILES_X + column);
            }
        }
    }
    return reached;
}
