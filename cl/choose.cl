// Which gaussians of a city a block of it trains, and how large its views show others.
//
// A cell is a box in coordinates u = turn p + shift of the partition's space, where `contracted` in
// those that the inf-norm contraction makes of them (clsplat/partition/region.py). space: real[12],
// turn by rows, then shift; cell: real[6], its lower and its upper ends, which may be infinite.
// positions, log_scales: real[N, 3], local; cameras: real[V, CAMERA_REALS]; outside: uint[N]. One
// writer a slot.
#include "real.h"
#include "each.h"
#include "camera.h"

#define SHOWN_DEVIATIONS 3 // from its centre, within which a view shows a gaussian

inline real largest_scale(ulong row, __global const real *log_scales)
{
    const real3 logs = vload3(row, log_scales);
    return exp(fmax(fmax(logs.x, logs.y), logs.z));
}

inline bool in_cell(real3 u, uint contracted, __global const real *cell)
{
    if (contracted) {
        const real largest = fmax(fmax(fmax(fabs(u.x), fabs(u.y)), fabs(u.z)), (real)1);
        u = u * ((2 - 1 / largest) / (4 * largest)) + (real)0.5;
    }
    const real3 low = vload3(0, cell), high = vload3(1, cell);
    return u.x >= low.x && u.y >= low.y && u.z >= low.z && u.x < high.x && u.y < high.y &&
           u.z < high.z; // not so for a nan
}

// outside[i] = 1 where gaussian i, or a place so many of its largest standard deviations from it
// along the axes u and v of the space, is not in the cell; what is 1 stays. Along u and v a length
// of 1 is step_u and step_v in coordinates.
__kernel void choose_outside(uint count, uint contracted, real deviations, real step_u, real step_v,
                             __global const real *restrict space,
                             __global const real *restrict cell,
                             __global const real *restrict positions,
                             __global const real *restrict log_scales,
                             __global uint *restrict outside)
{
    FOR_EACH(i, count) {
        if (outside[i])
            continue;
        const real3 p = vload3(i, positions);
        const real3 u = (real3)(dot(vload3(0, space), p), dot(vload3(1, space), p),
                                dot(vload3(2, space), p)) + vload3(3, space);
        const real spread = deviations > 0 ? deviations * largest_scale(i, log_scales) : 0;
        const real3 along_u = (real3)(spread * step_u, 0, 0);
        const real3 along_v = (real3)(0, spread * step_v, 0);
        if (!(in_cell(u, contracted, cell) && in_cell(u + along_u, contracted, cell) &&
              in_cell(u - along_u, contracted, cell) && in_cell(u + along_v, contracted, cell) &&
              in_cell(u - along_v, contracted, cell)))
            outside[i] = 1;
    }
}

// sizes[i] = two standard deviations of gaussian i in the view that shows it largest, pixels, at
// most 1; 0: no view shows it. 1 where it is not outside.
__kernel void choose_sizes(uint count, uint views, __global const real *restrict cameras,
                           __global const real *restrict positions,
                           __global const real *restrict log_scales,
                           __global const uint *restrict outside, __global real *restrict sizes)
{
    FOR_EACH(i, count) {
        const real3 world = vload3(i, positions);
        const real scale = largest_scale(i, log_scales);
        real largest = outside[i] ? 0 : 1;
        for (uint view = 0; view < views && largest < 1; view++) {
            __global const real *camera = cameras + view * CAMERA_REALS;
            const real3 p = to_camera(camera, world);
            const real2 focal = vload2(0, camera + CAMERA_FOCAL);
            const real2 size = vload2(0, camera + CAMERA_SIZE);
            const real deviation = scale * fmax(focal.x, focal.y) / p.z;
            const real2 pixel = focal * p.xy / p.z + vload2(0, camera + CAMERA_CENTRE);
            const real beyond = SHOWN_DEVIATIONS * deviation;
            if (p.z > camera[CAMERA_NEAR] && pixel.x > -beyond && pixel.y > -beyond &&
                pixel.x < size.x + beyond && pixel.y < size.y + beyond)
                largest = fmax(largest, 2 * deviation);
        }
        sizes[i] = fmin(largest, (real)1);
    }
}
