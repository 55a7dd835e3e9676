// A splat: the screen footprint of a gaussian, 12 reals a row, written by project.cl.
enum {
    SPLAT_MEAN = 0, // pixels
    SPLAT_OPACITY = 2,
    SPLAT_CUTOFF = 3, // 2 ln(255 opacity): beyond this squared distance alpha is below 1/255
    SPLAT_CONIC = 4, // a, b, c: squared distance = a dx^2 + 2 b dx dy + c dy^2
    SPLAT_EXTENT_Y = 7, // half height of the ellipse at the cutoff, pixels
    SPLAT_COLOUR = 8,
    SPLAT_DEPTH = 11,
    SPLAT_REALS = 12
};
#define ALPHA_MIN (1.0 / 255.0) // fainter contributions are skipped
#define ALPHA_MAX 0.99
#define TRANSMITTANCE_MIN 1e-4 // a pixel ends before it would fall below this

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
