// The gain of a lens, 1 + a u + b u^2 + c u^3, where u is s times the squared distance of a pixel
// from the optical axis, in focal lengths (clsplat/response.py). lens: a row (a, b, c, s) of
// lenses: real[L, VIGNETTING_REALS]; camera: camera.h.
#include "camera.h"

#define DEFINE_RADIUS(NAME, TYPE)                                                                  \
    inline TYPE NAME(__global const real *camera, __global const real *lens, TYPE x, TYPE y)       \
    {                                                                                              \
        const TYPE dx = (x - camera[CAMERA_CENTRE]) / camera[CAMERA_FOCAL];                        \
        const TYPE dy = (y - camera[CAMERA_CENTRE + 1]) / camera[CAMERA_FOCAL + 1];                \
        return lens[VIGNETTING_TERMS] * (dx * dx + dy * dy);                                       \
    }

#define GAIN(LENS, U) (1 + (U) * ((LENS)[0] + (U) * ((LENS)[1] + (U) * (LENS)[2])))
