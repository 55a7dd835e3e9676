// What a device can do at most, measured by kernels that do nothing else (ceilings.py).
#include "real.h"
#include "each.h"

// As wide as the kernels of each form load: a row of 16, or a vector of 4 a work-item.
#if FORM_ITEM
typedef real16 wide;
#define LOAD vload16
#define STORE vstore16
#else
typedef real4 wide;
#define LOAD vload4
#define STORE vstore4
#endif

// source, result: real[16 * count or 4 * count]
__kernel void copy_reals(uint count, __global const real *restrict source,
                         __global real *restrict result)
{
    FOR_EACH(i, count)
        STORE(LOAD(i, source), i, result);
}

// Eight independent chains hide the latency of a multiply-add; 16 operations a lane and round.
// factors: real[2]; results: real[16 * count or 4 * count], stored so that nothing is left out.
__kernel void multiply_add(uint count, uint rounds, __global const real *restrict factors,
                           __global real *restrict results)
{
    const wide a = factors[0], b = factors[1];
    FOR_EACH(i, count) {
        wide x0 = (real)i, x1 = x0 + 1, x2 = x0 + 2, x3 = x0 + 3;
        wide x4 = x0 + 4, x5 = x0 + 5, x6 = x0 + 6, x7 = x0 + 7;
        for (uint k = 0; k < rounds; k++) {
            x0 = mad(x0, a, b);
            x1 = mad(x1, a, b);
            x2 = mad(x2, a, b);
            x3 = mad(x3, a, b);
            x4 = mad(x4, a, b);
            x5 = mad(x5, a, b);
            x6 = mad(x6, a, b);
            x7 = mad(x7, a, b);
        }
        STORE(x0 + x1 + x2 + x3 + x4 + x5 + x6 + x7, i, results);
    }
}
