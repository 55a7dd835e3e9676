// Scene frequency (the SIG paper, ICLR 2026): how fine the detail is that gaussians hold, 1 / world
// unit. omega_i is the mean, the largest or the smallest (axes 0, 1, 2) of 1 / sigma_ik over k:
//
//   paper:    sum w omega / sum w,  w = o^2 det Sigma = (o s1 s2 s3)^2
//   release:  1 / mean sigma, of axis 0 over all i and k, of axes 1 and 2 of each smallest, largest
//   robust:   as release, of means weighted by opacity o
//
// w is a sixth power of size, far beyond single precision, so sums are of exp(logarithm - largest):
// `frequency_largest` and `max_columns` find the largest, `frequency_sums` (added up by reduce.cl)
// the sums, `frequency_values` the nine values; nan where no gaussian counts.
// log_scales: real[N, 3]; opacity_logits: real[N]; one row of partials a work-item, fixed order.
#include "real.h"
#include "each.h"
#define GROUP SCAN_GROUP
#include "group.h"

#define AXES 3
enum { // logarithms of what is summed
    TERM_WEIGHT, // paper's w
    TERM_POWER, // w omega, an axis each
    TERM_SIGMA = TERM_POWER + AXES, // the sigma that release averages, an axis each
    TERM_OPACITY = TERM_SIGMA + AXES, // robust's o
    TERM_SEEN // o sigma, an axis each
};
#define SUM_COUNT FREQUENCY_TERMS // sums: of exp(term - largest term), then how many count
typedef char each_term_has_a_column[TERM_SEEN + AXES == FREQUENCY_TERMS ? 1 : -1];
// Beyond this |log sigma|, single precision does not hold sigma, its inverse or the sum of three.
#define LARGEST_LOG 87.0

inline real log_sigmoid(real x)
{
    return fmin(x, (real)0) - log1p(exp(-fabs(x)));
}

inline real log_mean_exp(real3 x)
{
    const real3 e = exp(x);
    return log((e.x + e.y + e.z) / 3);
}

// Terms of a gaussian; false where it does not count.
inline bool terms_of(real3 log_scale, real logit, real *terms)
{
    // written to refuse what is not a number, too
    const real3 size = fabs(log_scale);
    if (!(size.x <= (real)LARGEST_LOG && size.y <= (real)LARGEST_LOG
          && size.z <= (real)LARGEST_LOG && isfinite(logit)))
        return false;
    const real log_opacity = log_sigmoid(logit);
    const real smallest = fmin(log_scale.x, fmin(log_scale.y, log_scale.z));
    const real largest = fmax(log_scale.x, fmax(log_scale.y, log_scale.z));
    const real log_omega[AXES] = {log_mean_exp(-log_scale), -smallest, -largest};
    const real log_sigma[AXES] = {log_mean_exp(log_scale), smallest, largest};
    terms[TERM_OPACITY] = log_opacity;
    terms[TERM_WEIGHT] = 2 * (log_opacity + log_scale.x + log_scale.y + log_scale.z);
    for (uint axis = 0; axis < AXES; axis++) {
        terms[TERM_POWER + axis] = terms[TERM_WEIGHT] + log_omega[axis];
        terms[TERM_SIGMA + axis] = log_sigma[axis];
        terms[TERM_SEEN + axis] = log_opacity + log_sigma[axis];
    }
    return true;
}

__kernel void frequency_largest(uint count, __global const real *restrict log_scales,
                                __global const real *restrict opacity_logits,
                                __global real *restrict partials)
{
    real terms[FREQUENCY_TERMS], largest[FREQUENCY_TERMS];
    for (uint k = 0; k < FREQUENCY_TERMS; k++)
        largest[k] = -INFINITY;
    FOR_EACH(i, count) {
        if (!terms_of(vload3(i, log_scales), opacity_logits[i], terms))
            continue;
        for (uint k = 0; k < FREQUENCY_TERMS; k++)
            largest[k] = fmax(largest[k], terms[k]);
    }
    for (uint k = 0; k < FREQUENCY_TERMS; k++)
        partials[get_global_id(0) * FREQUENCY_TERMS + k] = largest[k];
}

// maxima[c] = max_i partials[i, c]; a work-group of GROUP items a column.
__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void max_columns(uint count, __global const real *restrict partials, __global real *restrict maxima)
{
    __local real scratch[GROUP];
    const uint lane = get_local_id(0), column = get_group_id(0);
    real largest = -INFINITY;
    for (ulong i = lane; i < count; i += GROUP)
        largest = fmax(largest, partials[i * FREQUENCY_TERMS + column]);
    scratch[lane] = largest;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint stride = GROUP / 2; stride > 0; stride >>= 1) {
        if (lane < stride)
            scratch[lane] = fmax(scratch[lane], scratch[lane + stride]);
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (lane == 0)
        maxima[column] = scratch[0];
}

__kernel void frequency_sums(uint count, __global const real *restrict log_scales,
                             __global const real *restrict opacity_logits,
                             __global const real *restrict maxima, __global real *restrict partials)
{
    real terms[FREQUENCY_TERMS], sums[FREQUENCY_SUMS];
    for (uint k = 0; k < FREQUENCY_SUMS; k++)
        sums[k] = 0;
    FOR_EACH(i, count) {
        if (!terms_of(vload3(i, log_scales), opacity_logits[i], terms))
            continue;
        for (uint k = 0; k < FREQUENCY_TERMS; k++)
            sums[k] += exp(terms[k] - maxima[k]);
        sums[SUM_COUNT] += 1;
    }
    for (uint k = 0; k < FREQUENCY_SUMS; k++)
        partials[get_global_id(0) * FREQUENCY_SUMS + k] = sums[k];
}

// values: real[3 variants, 3 axes]; one work-item.
__kernel void frequency_values(__global const real *restrict maxima,
                               __global const real *restrict sums, __global real *restrict values)
{
    if (get_global_id(0) > 0)
        return;
    for (uint axis = 0; axis < AXES; axis++) {
        const uint power = TERM_POWER + axis, sigma = TERM_SIGMA + axis, seen = TERM_SEEN + axis;
        values[axis] = exp(maxima[power] - maxima[TERM_WEIGHT]
                           + log(sums[power] / sums[TERM_WEIGHT]));
        values[AXES + axis] = exp(log(sums[SUM_COUNT] / sums[sigma]) - maxima[sigma]);
        values[2 * AXES + axis] = exp(maxima[TERM_OPACITY] - maxima[seen]
                                      + log(sums[TERM_OPACITY] / sums[seen]));
    }
}
