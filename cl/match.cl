// For each feature of one photo the most similar ones of another, by the scalar product of their
// descriptors, which are unit vectors times 512: the best, and the value of the second best, as
// Lowe's ratio test needs them (2004, section 7.1).
//
//   interleave  the first K features of each photo, 16 beside each other, as numbers
//   nearest     of all K of the other photo
//   follow      of all features of the other photo that lie where the geometry of the two views
//               allows: within a distance of the epipolar line, or of the place to which a plane
//               takes them
//
// descriptors: uchar[V, M, 128]; points: real[V, 2, M], x of all, then y; M is a multiple of 16.
// counts: int[V], of features. spread: real[V, B, 128, 16], zero beyond a photo's features, K = 16
// B.
// pairs: int[P, 2], photo and other photo. geometry: real[P, 11]: a matrix F (3x3, by rows) with
// x2^T F x1 = 0, or that of the plane, x2 ~ F x1; 1 for a plane, else 0; the largest distance.
// nearest: int[P, K or M], -1 for none; products: real[P, K or M, 2], best and second, 0 for none.
// Products are integers below 2^24, exact in any order, so that both forms give the same; of equal
// ones the first counts.
#include "real.h"
#include "each.h"

__kernel void interleave(uint photos, uint features, uint blocks,
                         __global const int *restrict counts,
                         __global const uchar *restrict descriptors, __global real *restrict spread)
{
    FOR_EACH(i, photos * blocks * 16) { // so many bytes at once fit into one line of a cache
        const uint photo = i / (blocks * 16), feature = i % (blocks * 16);
        __global real *to =
            spread + ((ulong)photo * blocks + feature / 16) * DESCRIPTOR_SIZE * 16 + feature % 16;
        __global const uchar *from =
            descriptors + ((ulong)photo * features + feature) * DESCRIPTOR_SIZE;
        for (int k = 0; k < DESCRIPTOR_SIZE; k++)
            to[16 * k] = (int)feature < counts[photo] ? from[k] : 0;
    }
}

// Where the other photo may show a feature: near a line a x + b y + c = 0, of which (a, b) is a
// unit vector, or near a place. As pairs are compared both ways, lines count in both photos.
typedef struct {
    real a, b, c, most;
    bool is_plane;
} Allowed;

INLINE Allowed allowed_places(__global const real *geometry, real x, real y)
{
    real image[3];
    for (int row = 0; row < 3; row++)
        image[row] = geometry[3 * row] * x + geometry[3 * row + 1] * y + geometry[3 * row + 2];
    const bool is_plane = geometry[9] != 0;
    const real by = is_plane ? image[2] : hypot(image[0], image[1]);
    const Allowed allowed = {image[0] / by, image[1] / by, image[2] / by, geometry[10], is_plane};
    return allowed;
}

// How far a place is from there, squared; both for one place and for 16 of them.
#define AWAY_SQUARED(TYPE, ALLOWED, X, Y, RESULT)                                                  \
    if (ALLOWED.is_plane) {                                                                        \
        const TYPE dx = X - ALLOWED.a, dy = Y - ALLOWED.b;                                         \
        RESULT = MAD(dx, dx, dy * dy);                                                             \
    } else {                                                                                       \
        const TYPE away = MAD((TYPE)ALLOWED.a, X, MAD((TYPE)ALLOWED.b, Y, (TYPE)ALLOWED.c));       \
        RESULT = away * away;                                                                      \
    }

#if FORM_ITEM
#include "item/match.cl"
#else
#include "group/match.cl"
#endif
