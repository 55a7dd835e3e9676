// What densification wants to know of each gaussian, summed over views: the norm of the screen
// gradient of its mean in NDC units (pixel gradient x W/2, H/2; Kerbl et al. 2023), and how many
// views saw it. grad_means: real[V, 2], pixels; rows: uint[V], of which counts[COUNT_VISIBLE]
// exist; sums over N gaussians, in place.
#include "real.h"
#include "each.h"
#include "counts.h"

__kernel void accumulate(real half_width, real half_height, __global const uint *restrict counts,
                         __global const uint *restrict rows, __global const real *restrict grad_means,
                         __global real *restrict grad_norm_sum, __global uint *restrict seen_count)
{
    FOR_EACH(v, counts[COUNT_VISIBLE]) {
        if (rows[v] == NO_ROW)
            continue;
        const real2 g = vload2(v, grad_means) * (real2)(half_width, half_height);
        grad_norm_sum[rows[v]] += length(g);
        seen_count[rows[v]] += 1;
    }
}
