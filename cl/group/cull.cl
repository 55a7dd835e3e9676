// Group form of cull.cl (see there): a group owns a chunk, a work-item a row at a time.
CHUNK_KERNEL
void cull(CULL_ARGUMENTS)
{
    CHUNK_SCRATCH
    const uint begin = CHUNK_INDEX * chunk, end = min(begin + chunk, count);
    uint seen = 0;
    FOR_CHUNK(row, begin, end) {
        const real3 p = to_camera(camera, vload3(row, positions)), s = vload3(row, log_scales);
        const bool flag = may_meet_image(camera, p.x, p.y, p.z, max(s.x, max(s.y, s.z))) &&
                          footprint_meets_image(row, camera, positions, log_scales, quaternions,
                                                opacity_logits);
        flags[row] = flag;
        seen += flag;
    }
    const uint total = CHUNK_TOTAL(seen);
    if (CHUNK_LEADS)
        totals[CHUNK_INDEX] = total;
}
