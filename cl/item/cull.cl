// Item form of cull.cl (see there): a work-item owns a chunk, and looks at 16 rows at once.
#include "rows.h"

CHUNK_KERNEL
void cull(CULL_ARGUMENTS)
{
    const uint begin = CHUNK_INDEX * chunk, end = min(begin + chunk, count);
    uint seen = 0, rows[16];
    for (uint first = begin; first < end; first += 16) {
        const uint number = min(end - first, 16u);
        real16 x, y, z;
        load_in_camera(camera, positions + 3ul * first, number, &x, &y, &z);
        const real16 log_scale = load_largest(log_scales + 3ul * first, number);
        const uint listed =
            list_rows(may_meet_image(camera, x, y, z, log_scale), first, number, rows);
        for (uint i = 0; i < number; i++)
            flags[first + i] = 0;
        for (uint i = 0; i < listed; i++) {
            const bool flag = footprint_meets_image(rows[i], camera, positions, log_scales,
                                                    quaternions, opacity_logits);
            flags[rows[i]] = flag;
            seen += flag;
        }
    }
    totals[CHUNK_INDEX] = seen;
}
