// A splat: the screen footprint of a gaussian, 12 reals a row, written by project.cl.
enum {
    SPLAT_MEAN = 0, // pixels
    SPLAT_OPACITY = 2,
    SPLAT_CUTOFF = 3, // 2 ln(opacity / ALPHA_MIN): beyond this squared distance alpha is below it
    SPLAT_CONIC = 4, // a, b, c: squared distance = a dx^2 + 2 b dx dy + c dy^2
    SPLAT_EXTENT_Y = 7, // half height of the ellipse at the cutoff, pixels
    SPLAT_COLOUR = 8,
    SPLAT_DEPTH = 11,
    SPLAT_REALS = 12
};
// docs/notebook/numerics.md compares other values of these two
#ifndef ALPHA_STEPS
#define ALPHA_STEPS 255
#endif
#ifndef TRANSMITTANCE_MIN
#define TRANSMITTANCE_MIN 1e-4 // a pixel ends before it would fall below this
#endif
#define ALPHA_MIN (1.0 / ALPHA_STEPS) // fainter contributions are skipped
#define ALPHA_MAX 0.99

// Sums over a splat's pixels that the blend adjoint leaves, one row a pair.
enum {
    SUM_COLOUR = 0,
    SUM_OPACITY = 3,
    SUM_X = 4, // sum of grad_power * dx, and so on
    SUM_Y = 5,
    SUM_XX = 6,
    SUM_XY = 7,
    SUM_YY = 8,
    SUM_DEPTH = 9 // only where a loss reads the depth channel
};
