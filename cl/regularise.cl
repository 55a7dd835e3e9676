// L1 regularisation of opacities and sizes (Kheradmand et al. 2024): a view's loss has
//
//   opacity_weight mean(o) + scale_weight mean(s)
//
// beside the image's, over the V gaussians that the view sees and the three standard deviations s
// of each. So every step regularises the rows that it moves anyway, and over the views a gaussian
// counts as much as in a mean over all gaussians. Its gradient is added to that of the logits and
// logarithms:
//
//   grad_opacity_logits += opacity_weight o (1 - o) / V
//   grad_log_scales += scale_weight s / (3 V)
//
// rows: uint[V], the row of each gradient; NO_ROW is skipped; of the V, counts[COUNT_VISIBLE]
// exist. A gaussian that is seen has a footprint, so that s is finite. Elementwise, one writer
// each.
#include "real.h"
#include "each.h"
#include "counts.h"

__kernel void regularise(real opacity_weight, real scale_weight,
                         __global const uint *restrict counts, __global const uint *restrict rows,
                         __global const real *restrict opacity_logits,
                         __global const real *restrict log_scales,
                         __global real *restrict grad_opacity_logits,
                         __global real *restrict grad_log_scales)
{
    const uint count = counts[COUNT_VISIBLE];
    FOR_EACH(v, count) {
        const uint row = rows[v];
        if (row == NO_ROW)
            continue;
        const real opacity = 1 / (1 + exp(-opacity_logits[row]));
        grad_opacity_logits[v] += opacity_weight / count * opacity * (1 - opacity);
        vstore3(vload3(v, grad_log_scales) +
                    scale_weight / (3 * (real)count) * exp(vload3(row, log_scales)),
                v, grad_log_scales);
    }
}
