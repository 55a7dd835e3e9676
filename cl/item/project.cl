// Item form of project.cl (see there): a work-item walks gaussians by itself.
#include "prefetch.h"
#define GAUSSIANS_MEMORY ulong soon; // the gaussian whose numbers are asked for
#define FOR_EACH_GAUSSIAN(v, count, LOADED)                                                        \
    FOR_EACH(v, count)                                                                             \
        if (soon = min(v + AHEAD, (ulong)(count) - 1), LOADED)
#define HARMONIC(k) vload3(REST_ROW(rows[v]) * SH_REST + (k), sh_rest)
#define LOAD_HARMONICS(count)                                                                      \
    (prefetch_gaussian(rows[soon], REST_ROW(rows[soon]), positions, sh_constant, sh_rest,          \
                       opacity_logits, log_scales, quaternions), true)
#define LOAD_SUMS(count)                                                                           \
    (prefetch_pairs(offsets[soon] * (ulong)SUMS, splat_counts[soon] * (ulong)SUMS, pair_grads),    \
     true)
#define SUMS_OF(v, sum)                                                                            \
    real sum[SUMS];                                                                                \
    add_pairs(v, splat_counts, offsets, pair_grads, earlier, sum)

// The first pairs of a splat; what follows is read in order, which processors foresee.
inline void prefetch_pairs(ulong begin, ulong number, __global const real *pair_grads)
{
    const ulong most = min(number, 8 * LINE_OF(pair_grads));
    for (ulong i = 0; i < most; i += LINE_OF(pair_grads))
        PREFETCH(pair_grads + begin + i);
}

// Eight columns are one vector, or Intel's compiler would sum every column over several pairs at a
// time, in another order.
inline void add_pairs(ulong v, __global const uint *splat_counts, __global const uint *offsets,
                      __global const real *pair_grads, __global const real *earlier, real *sum)
{
    real8 total = CARRIED ? vload8(0, earlier + v * SUMS) : (real8)(0);
    for (int j = 8; j < SUMS; j++)
        sum[j] = CARRIED ? earlier[v * SUMS + j] : 0;
    const ulong begin = (ulong)offsets[v] * SUMS, end = begin + (ulong)splat_counts[v] * SUMS;
    for (ulong i = begin; i < end; i += SUMS) {
        total += vload8(0, pair_grads + i);
        for (int j = 8; j < SUMS; j++)
            sum[j] += pair_grads[i + j];
    }
    vstore8(total, 0, sum);
}
