// A splat: the screen footprint of a gaussian, SPLAT_REALS a row, written by project.cl. Its
// columns, SPLAT_MEAN and so on, are in clsplat/constants.py.
#define ALPHA_MIN (1.0 / ALPHA_STEPS) // fainter contributions are skipped

// Sums over a splat's pixels that the blend adjoint leaves, one row a pair.
enum {
    SUM_COLOUR = 0,
    SUM_OPACITY = 3,
    SUM_X = 4, // sum of grad_power * dx, and so on
    SUM_Y = 5,
    SUM_XX = 6,
    SUM_XY = 7,
    SUM_YY = 8,
    SUM_DEPTH = PAIR_SUMS // only where a loss reads the depth channel
};
