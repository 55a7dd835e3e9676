// Random steps of the positions, so that gaussians explore the scene (Kheradmand et al. 2024, eq.
// 8):
//
//   position <- position + amount gate(opacity) Sigma eta,   eta: three standard normal numbers,
//   gate(o) = 1 / (1 + exp(NOISE_SHARPNESS (o - NOISE_OPACITY)))
//
// which moves nearly transparent gaussians only, along their own extent. Rows stay where the gate
// is below NOISE_LEAST, where they are frozen and where the step would not be finite. Every other
// row moves, whether or not the view saw it, with the scales and the rotation that are stored:
// those of a row that lags (adam.cl) are at most CATCH_UP_EVERY steps old.
//
// eta depends on (seed, now, row) alone: a hash (Jarzynski and Olano 2020, pcg4d) gives four
// uniform numbers, and Box and Muller's transform three normal ones, at most 5.8 in size. now: the
// number of the step. Elementwise, one writer each. Nothing moves once a frame has failed.
#include "real.h"
#include "each.h"
#include "counts.h"
#include "quaternion.h"
#define NOISE_SHARPNESS 100
#define NOISE_OPACITY (real)0.005
#define NOISE_LEAST (real)1e-5

inline uint4 hash_of(uint4 v)
{
    v = v * 1664525u + 1013904223u;
    for (int round = 0; round < 2; round++) {
        v.x += v.y * v.w;
        v.y += v.z * v.x;
        v.z += v.x * v.y;
        v.w += v.y * v.z;
        if (round == 0)
            v ^= v >> 16;
    }
    return v;
}

// Between 0 and 1, never either, and exact in single precision.
inline real uniform_of(uint hash)
{
    return ((real)(hash >> 9) + (real)0.5) * (real)(1.0f / (1 << 23));
}

inline real3 normal_numbers(uint4 key)
{
    const uint4 hash = hash_of(key);
    const real angle = 2 * uniform_of(hash.y);
    const real radius = sqrt(-2 * log(uniform_of(hash.x)));
    return (real3)(radius * cospi(angle), radius * sinpi(angle),
                   sqrt(-2 * log(uniform_of(hash.z))) * cospi(2 * uniform_of(hash.w)));
}

__kernel void noise(uint count, uint seed, uint now, real amount, uint has_frozen,
                    __global const uint *restrict counts, __global const uint *restrict frozen,
                    __global const real *restrict log_scales,
                    __global const real *restrict quaternions,
                    __global const real *restrict opacity_logits,
                    __global real *restrict positions)
{
    if (counts[COUNT_FAILED])
        return;
    FOR_EACH(row, count) {
        const real opacity = 1 / (1 + exp(-opacity_logits[row]));
        const real gate = 1 / (1 + exp(NOISE_SHARPNESS * (opacity - NOISE_OPACITY)));
        if (!(gate >= NOISE_LEAST) || (has_frozen && frozen[row]))
            continue;
        const real3 eta = normal_numbers((uint4)((uint)row, now, seed, 0));
        real length_of_quaternion;
        real3 row0, row1, row2;
        rotation_rows(unit_quaternion(vload4(row, quaternions), &length_of_quaternion), &row0,
                      &row1, &row2);
        const real3 variances = exp(2 * vload3(row, log_scales));
        const real3 own = variances * (row0 * eta.x + row1 * eta.y + row2 * eta.z);
        const real3 moved = vload3(row, positions) +
                            amount * gate * (real3)(dot(row0, own), dot(row1, own), dot(row2, own));
        if (isfinite(moved.x + moved.y + moved.z))
            vstore3(moved, row, positions);
    }
}
