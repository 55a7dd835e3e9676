// The response of a camera to a blended image (clsplat/response.py), and the backdrop of a view:
//
//   c' = M (g (F + T_F c)) + t,   c = C + T B
//
// WITH_RESPONSE: [M | t] is row `view` of transforms: real[V, TRANSFORM_REALS], in row-major order.
// WITH_VIGNETTING: g = 1 + a u + b u^2 + c u^3 is the gain of the view's lens, (a, b, c, s): row
// lens_of[view] of lenses: real[L, VIGNETTING_REALS]; u is s times the squared distance of a pixel
// from the optical axis, in focal lengths (camera: camera.h).
// BACKDROP_PLANES: what surrounds a block of a city, drawn once for a view; backdrop: uchar[planes,
// H, W], 255 is one. The first three are the colour B behind the block, with the background; if
// there are seven, the others are the colour F in front of it and its transmittance T_F.
#include "camera.h"

#ifndef WITH_RESPONSE
#define WITH_RESPONSE 0
#endif
#ifndef WITH_VIGNETTING
#define WITH_VIGNETTING 0
#endif
#ifndef BACKDROP_PLANES
#define BACKDROP_PLANES 0
#endif
#define FRONT_PLANE 3
#define HAS_FRONT (BACKDROP_PLANES > FRONT_PLANE)
#define RESPONSE_TERMS (TRANSFORM_REALS + WITH_VIGNETTING * VIGNETTING_TERMS) // that are learned
#define BYTE_UNIT ((real)(1.0 / 255))
#define ONE_BYTE(P) (*(P)*BYTE_UNIT)
#define SIXTEEN_BYTES(P) (convert_real16(vload16(0, P)) * BYTE_UNIT)

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
// BEHIND: a channel behind the splats at a pixel, or at a row of pixels for a LOAD that converts as
// many bytes; LOAD_FRONT sets FRONT[4] to F and T_F there.
#if BACKDROP_PLANES
#define BACKDROP_ARGUMENT , __global const uchar *restrict backdrop
#define BACKDROP_VALUE , backdrop
#define BEHIND(CHANNEL, PIXEL, LOAD) LOAD(backdrop + (CHANNEL)*plane + (PIXEL))
#else
#define BACKDROP_ARGUMENT
#define BACKDROP_VALUE
#define BEHIND(CHANNEL, PIXEL, LOAD) background[CHANNEL]
#endif
#if HAS_FRONT
#define LOAD_FRONT(FRONT, PIXEL, LOAD)                                                             \
    for (int k = 0; k < 4; k++)                                                                    \
    FRONT[k] = LOAD(backdrop + (FRONT_PLANE + k) * plane + (PIXEL))
#else
#define LOAD_FRONT(FRONT, PIXEL, LOAD)
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
// in its place; and the adjoint, which turns the gradient by the response into that by the blended
// colour, and adds to `sums` the gradients by the terms. With G the gradient by c' and s = F + T_F
// c, the gradient is T_F g M^T G; the sums are of G (x) [g s, 1] and (M^T G . s) [u, u^2, u^3].
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
    INLINE void respond##SUFFIX(const Response *response, TYPE u, const TYPE *front, TYPE *colour) \
    {                                                                                              \
        const real *e = response->terms;                                                           \
        const TYPE gain = lens_gain##SUFFIX(response, u);                                          \
        for (int k = 0; k < 3; k++) {                                                              \
            if (HAS_FRONT)                                                                         \
                colour[k] = front[3] * colour[k] + front[k];                                       \
            if (WITH_VIGNETTING)                                                                   \
                colour[k] *= gain;                                                                 \
        }                                                                                          \
        const TYPE red = colour[0], green = colour[1], blue = colour[2];                           \
        for (int k = 0; k < 3; k++)                                                                \
            colour[k] =                                                                            \
                e[4 * k] * red + e[4 * k + 1] * green + e[4 * k + 2] * blue + e[4 * k + 3];        \
    }                                                                                              \
    INLINE void respond_adjoint##SUFFIX(const Response *response, TYPE u, const TYPE *front,       \
                                        TYPE *colour, TYPE *grad, TYPE *sums)                      \
    {                                                                                              \
        const real *e = response->terms;                                                           \
        TYPE by[3];                                                                                \
        for (int k = 0; k < 3; k++) {                                                              \
            if (HAS_FRONT)                                                                         \
                colour[k] = front[3] * colour[k] + front[k];                                       \
            by[k] = 0;                                                                             \
        }                                                                                          \
        const TYPE gain = lens_gain##SUFFIX(response, u);                                          \
        for (int k = 0; k < 3; k++) {                                                              \
            const TYPE gained = grad[k] * gain;                                                    \
            for (int j = 0; j < 3; j++) {                                                          \
                by[j] += e[4 * k + j] * grad[k];                                                   \
                sums[4 * k + j] += gained * colour[j];                                             \
            }                                                                                      \
            sums[4 * k + 3] += grad[k];                                                            \
        }                                                                                          \
        for (int k = 0; k < 3; k++) {                                                              \
            grad[k] = gain * by[k];                                                                \
            if (HAS_FRONT)                                                                         \
                grad[k] = front[3] * grad[k];                                                      \
        }                                                                                          \
        if (WITH_VIGNETTING) {                                                                     \
            TYPE by_term = by[0] * colour[0] + by[1] * colour[1] + by[2] * colour[2];              \
            for (int k = TRANSFORM_REALS; k < RESPONSE_TERMS; k++) {                               \
                by_term *= u;                                                                      \
                sums[k] += by_term;                                                                \
            }                                                                                      \
        }                                                                                          \
    }
