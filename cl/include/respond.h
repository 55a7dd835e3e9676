// The response of a camera to a blended image (clsplat/response.py): c' = M (g c) + t.
//
// WITH_RESPONSE: [M | t] is row `view` of transforms: real[V, TRANSFORM_REALS], in row-major order.
// WITH_VIGNETTING: g = 1 + a u + b u^2 + c u^3 is the gain of the view's lens, (a, b, c, s): row
// lens_of[view] of lenses: real[L, VIGNETTING_REALS]; u is s times the squared distance of a pixel
// from the optical axis, in focal lengths (camera: camera.h).
#include "camera.h"

#ifndef WITH_RESPONSE
#define WITH_RESPONSE 0
#endif
#ifndef WITH_VIGNETTING
#define WITH_VIGNETTING 0
#endif
#define RESPONSE_TERMS (TRANSFORM_REALS + WITH_VIGNETTING * VIGNETTING_TERMS) // that are learned

// Arguments of kernels, each after a comma, if a build has them; and what becomes of them.
#if WITH_RESPONSE
#define IF_RESPONSE(CODE) CODE
#define RESPONSE_ARGUMENTS                                                                         \
    , uint view, __global const real *restrict transforms LENS_ARGUMENTS
#define EXPOSED_ARGUMENT , __global real *restrict exposed
#else
#define IF_RESPONSE(CODE)
#define RESPONSE_ARGUMENTS
#define EXPOSED_ARGUMENT
#endif
#if WITH_VIGNETTING
#define LENS_ARGUMENTS                                                                             \
    , __global const real *restrict camera, __global const uint *restrict lens_of,                 \
        __global const real *restrict lenses
#define LOAD_LENS(RESPONSE)                                                                        \
    load_lens(&(RESPONSE), camera, lenses + lens_of[view] * VIGNETTING_REALS)
#define RADIUS(SUFFIX, RESPONSE, X, Y) squared_radius##SUFFIX(&(RESPONSE), X, Y)
#else
#define LENS_ARGUMENTS
#define LOAD_LENS(RESPONSE)
#define RADIUS(SUFFIX, RESPONSE, X, Y) 0
#endif
// What a view's response is made of. terms: [M | t], and (a, b, c) of its lens.
typedef struct {
    real terms[RESPONSE_TERMS];
    real scale, centre[2], focal[2];
} Response;

INLINE void load_lens(Response *response, __global const real *camera, __global const real *lens)
{
    for (int k = TRANSFORM_REALS; k < RESPONSE_TERMS; k++)
        response->terms[k] = lens[k - TRANSFORM_REALS];
    response->scale = lens[VIGNETTING_TERMS];
    for (int k = 0; k < 2; k++) {
        response->centre[k] = camera[CAMERA_CENTRE + k];
        response->focal[k] = camera[CAMERA_FOCAL + k];
    }
}

#define LOAD_RESPONSE(RESPONSE)                                                                    \
    for (int k = 0; k < TRANSFORM_REALS; k++)                                                      \
        (RESPONSE).terms[k] = transforms[(ulong)view * TRANSFORM_REALS + k];                       \
    LOAD_LENS(RESPONSE)

// Of a pixel or of 16 neighbours: u at pixel coordinates (x, y); the response of a blended colour,
// in its place; and the adjoint, which turns the gradient by the response into that by the colour,
// and adds to `sums` the gradients by the terms. With G the gradient by c' the gradient is g M^T G;
// the sums are of G (x) [g c, 1] and (M^T G . c) [u, u^2, u^3].
#define DEFINE_RESPONSE(SUFFIX, TYPE)                                                              \
    INLINE TYPE squared_radius##SUFFIX(const Response *response, TYPE x, TYPE y)                   \
    {                                                                                              \
        const TYPE dx = (x - response->centre[0]) / response->focal[0];                            \
        const TYPE dy = (y - response->centre[1]) / response->focal[1];                            \
        return response->scale * (dx * dx + dy * dy);                                              \
    }                                                                                              \
    INLINE TYPE lens_gain##SUFFIX(const Response *response, TYPE u)                                \
    {                                                                                              \
        const real *lens = response->terms + TRANSFORM_REALS;                                      \
        return WITH_VIGNETTING ? 1 + u * (lens[0] + u * (lens[1] + u * lens[2])) : 1;              \
    }                                                                                              \
    INLINE void respond##SUFFIX(const Response *response, TYPE u, TYPE *colour)                    \
    {                                                                                              \
        const real *e = response->terms;                                                           \
        const TYPE gain = lens_gain##SUFFIX(response, u);                                          \
        for (int k = 0; k < 3; k++)                                                                \
            if (WITH_VIGNETTING)                                                                   \
                colour[k] *= gain;                                                                 \
        const TYPE red = colour[0], green = colour[1], blue = colour[2];                           \
        for (int k = 0; k < 3; k++)                                                                \
            colour[k] =                                                                            \
                e[4 * k] * red + e[4 * k + 1] * green + e[4 * k + 2] * blue + e[4 * k + 3];        \
    }                                                                                              \
    INLINE void respond_adjoint##SUFFIX(const Response *response, TYPE u, const TYPE *colour,      \
                                        TYPE *grad, TYPE *sums)                                    \
    {                                                                                              \
        const real *e = response->terms;                                                           \
        TYPE by[3];                                                                                \
        for (int k = 0; k < 3; k++)                                                                \
            by[k] = 0;                                                                             \
        const TYPE gain = lens_gain##SUFFIX(response, u);                                          \
        for (int k = 0; k < 3; k++) {                                                              \
            const TYPE gained = grad[k] * gain;                                                    \
            for (int j = 0; j < 3; j++) {                                                          \
                by[j] += e[4 * k + j] * grad[k];                                                   \
                sums[4 * k + j] += gained * colour[j];                                             \
            }                                                                                      \
            sums[4 * k + 3] += grad[k];                                                            \
        }                                                                                          \
        for (int k = 0; k < 3; k++)                                                                \
            grad[k] = gain * by[k];                                                                \
        if (WITH_VIGNETTING) {                                                                     \
            TYPE by_term = by[0] * colour[0] + by[1] * colour[1] + by[2] * colour[2];              \
            for (int k = TRANSFORM_REALS; k < RESPONSE_TERMS; k++) {                               \
                by_term *= u;                                                                      \
                sums[k] += by_term;                                                                \
            }                                                                                      \
        }                                                                                          \
    }
