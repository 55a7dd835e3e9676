// A splat: the screen footprint of a gaussian, SPLAT_REALS a row, written by project.cl. Its
// columns, SPLAT_MEAN and so on, are in clsplat/constants.py.
#define ALPHA_MIN (1.0 / ALPHA_STEPS) // fainter contributions are skipped

#ifndef CHANNELS
#define CHANNELS 3 // of colour; features have others (channels.h)
#endif
#ifndef WITH_DEPTH
#define WITH_DEPTH 0
#endif

// Sums over a splat's pixels that the blend adjoint leaves, SUMS of a pair. There are at least
// eight, so a single channel has a zero beside it.
enum {
    SUM_OPACITY,
    SUM_X, // sum of grad_power * dx, and so on
    SUM_Y,
    SUM_XX,
    SUM_XY,
    SUM_YY
};
#define SUM_COLOUR SHAPE_SUMS // the first channel
#define COLOUR_SUMS (CHANNELS > 1 ? CHANNELS : 2)
#define SUM_DEPTH (SUM_COLOUR + COLOUR_SUMS) // only where a loss reads the depth channel
#define SUMS (SUM_DEPTH + WITH_DEPTH)
typedef char every_sum_has_a_column[SUM_YY + 1 == SHAPE_SUMS ? 1 : -1];
