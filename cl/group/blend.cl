// Group form of blend.cl (see there), for GPUs. Forward, a group owns a tile and stages splats in
// local memory; it notes T and C of every pixel once a bucket of BUCKET pairs. Adjoint, a group of BUCKET
// lanes owns a bucket: lane l holds splat l while the tile's pixels stream through the lanes,
// (T, C . grad) passing from lane to lane, so that each lane sums its own splat without any reduction.
#define PIXELS (TILE * TILE)

// Checkpoints: real4[buckets, PIXELS] of (T, C) and, with depth, real[buckets, PIXELS] of depth.
__kernel __attribute__((reqd_work_group_size(PIXELS, 1, 1)))
void blend(BLEND_ARGUMENTS, __global const uint *restrict bucket_offsets,
           __global real *restrict checkpoints, __global real *restrict depth_checkpoints)
{
    __local real4 shape[PIXELS], colour[PIXELS], conic[PIXELS];
    __local int open;
    const int tile = get_group_id(0), lane = get_local_id(0), place = first_tile + tile;
    const int column = place % tiles_x * TILE + lane % TILE;
    const int row = place / tiles_x * TILE + lane / TILE;
    const bool inside = column < width && row < height;
    const uint begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const real x = column + 0.5, y = row + 0.5;
    real t = 1, z = 0;
    real3 c = (real3)(0);
    int latest = -1;
    bool done = !inside;
    ulong bucket = bucket_offsets[tile];
    for (uint base = begin; base < end; base += PIXELS) {
        if (lane == 0)
            open = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (!done)
            open = 1; // every writer writes the same
        if (base + lane < end) {
            __global const real *splat = splats + (ulong)sorted_splats[base + lane] * SPLAT_REALS;
            shape[lane] = vload4(0, splat);
            conic[lane] = vload4(1, splat);
            colour[lane] = vload4(2, splat);
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        if (!open) // read by all after a barrier: the group leaves together
            break;
        const int batch = min((uint)PIXELS, end - base);
        for (int j = 0; j < batch; j++) {
            if (j % BUCKET == 0) {
                vstore4((real4)(t, c), bucket * PIXELS + lane, checkpoints);
#if WITH_DEPTH
                depth_checkpoints[bucket * PIXELS + lane] = z;
#endif
                bucket++;
            }
            const real4 s = shape[j], k = conic[j];
            const real dx = x - s.x, dy = y - s.y;
            const real power = -0.5 * (k.x * dx * dx + k.z * dy * dy) - k.y * dx * dy;
            if (!done && power >= -0.5 * s.w) {
                const real w = cut_alpha(s.z * exp_power(power)) * t, next = t - w;
                done = next < (real)TRANSMITTANCE_MIN;
                if (!done) {
                    c += w * colour[j].xyz;
                    z += w * colour[j].w;
                    t = next;
                    latest = base + j;
                }
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (inside) {
        const long plane = (long)width * height, pixel = (long)row * width + column;
        image[pixel] = c.x + t * background[0];
        image[plane + pixel] = c.y + t * background[1];
        image[2 * plane + pixel] = c.z + t * background[2];
        transmittance[pixel] = t;
        last_contributor[pixel] = latest;
#if WITH_DEPTH
        depth[pixel] = z;
#endif
    }
}

// Passes a value from each lane of the group to the next. The local form needs one barrier a step:
// two buffers alternate, so that no lane overwrites what its neighbour has yet to read.
#if HAVE_PTX_SHUFFLE && !REAL_IS_DOUBLE && BUCKET == 32
inline real from_previous_lane(real value)
{
    real previous;
    asm volatile("shfl.sync.up.b32 %0, %1, 1, 0x0, 0xffffffff;" : "=f"(previous) : "f"(value));
    return previous;
}
#define PASS_ON(STEP)                                                                              \
    t = from_previous_lane(t);                                                                     \
    seen = from_previous_lane(seen);
#else
#define PASS_ON(STEP)                                                                              \
    passed[(STEP) & 1][lane] = (real2)(t, seen);                                                   \
    barrier(CLK_LOCAL_MEM_FENCE);                                                                  \
    {                                                                                              \
        const real2 previous = passed[(STEP) & 1][max(lane - 1, 0)];                               \
        t = previous.x;                                                                            \
        seen = previous.y;                                                                         \
    }
#endif

__kernel __attribute__((reqd_work_group_size(BUCKET, 1, 1)))
void blend_adjoint(BLEND_ADJOINT_ARGUMENTS, __global const uint *restrict counts,
                   __global const uint *restrict bucket_offsets,
                   __global const uint *restrict bucket_tiles, __global const real *restrict image,
                   __global const real *restrict depth, __global const real *restrict checkpoints,
                   __global const real *restrict depth_checkpoints)
{
    __local real4 grads[PIXELS]; // colour cotangent; .w = cotangent . all that the pixel holds
    __local real grads_z[PIXELS];
    __local int lasts[PIXELS];
    __local real2 passed[2][BUCKET];
    __local int newest;
    const uint bucket = get_group_id(0);
    if (bucket >= counts[COUNT_BUCKETS]) // the launch is an upper bound; the whole group leaves
        return;
    const uint tile = bucket_tiles[bucket];
    const int lane = get_local_id(0), place = first_tile + tile;
    const int x0 = place % tiles_x * TILE, y0 = place / tiles_x * TILE;
    const long plane = (long)width * height;
    const int first = ranges[2 * tile] + (bucket - bucket_offsets[tile]) * BUCKET;
    const int end = ranges[2 * tile + 1], own = first + lane;
    if (lane == 0)
        newest = -1;
    barrier(CLK_LOCAL_MEM_FENCE);
    int own_newest = -1;
    for (int p = lane; p < PIXELS; p += BUCKET) {
        const int column = x0 + p % TILE, row = y0 + p / TILE;
        const long pixel = (long)row * width + column;
        real4 g = (real4)(0);
        real gz = 0;
        int latest = -1;
        if (column < width && row < height) {
            const real3 cotangent = (real3)(grad_image[pixel], grad_image[plane + pixel],
                                            grad_image[2 * plane + pixel]);
            const real3 colour =
                (real3)(image[pixel], image[plane + pixel], image[2 * plane + pixel]);
            g = (real4)(cotangent, dot(cotangent, colour));
#if WITH_DEPTH
            gz = grad_depth[pixel];
            g.w += gz * depth[pixel] + grad_transmittance[pixel] * transmittance[pixel];
#endif
            latest = last_contributor[pixel];
        }
        grads[p] = g;
        grads_z[p] = gz;
        lasts[p] = latest;
        own_newest = max(own_newest, latest);
    }
    atomic_max(&newest, own_newest);
    barrier(CLK_LOCAL_MEM_FENCE);

    const bool valid = own < end;
    real4 s = (real4)(0), k = (real4)(0), colour = (real4)(0);
    if (valid) {
        __global const real *splat = splats + (ulong)sorted_splats[own] * SPLAT_REALS;
        s = vload4(0, splat);
        k = vload4(1, splat);
        colour = vload4(2, splat);
    }
    real3 s_colour = (real3)(0);
    real s_opacity = 0, s_x = 0, s_y = 0, s_xx = 0, s_xy = 0, s_yy = 0, s_z = 0;
    if (newest >= first) { // the same for every lane
        real t = 0, seen = 0; // in front of the lane's splat: transmittance, cotangent . colour
        for (int step = 0; step < PIXELS + BUCKET - 1; step++) {
            PASS_ON(step)
            const int p = step - lane;
            const bool active = p >= 0 && p < PIXELS;
            const real4 g = active ? grads[p] : (real4)(0);
            const real gz = active ? grads_z[p] : 0;
            if (lane == 0 && active) {
                const real4 from = vload4((ulong)bucket * PIXELS + p, checkpoints);
                t = from.x;
                seen = dot(from.yzw, g.xyz);
#if WITH_DEPTH
                seen += depth_checkpoints[(ulong)bucket * PIXELS + p] * gz;
#endif
            }
            if (active && valid && own <= lasts[p]) {
                const real dx = x0 + p % TILE + 0.5 - s.x, dy = y0 + p / TILE + 0.5 - s.y;
                const real power = -0.5 * (k.x * dx * dx + k.z * dy * dy) - k.y * dx * dy;
                if (power >= -0.5 * s.w) {
                    const real e = exp_power(power), raw = s.z * e, alpha = cut_alpha(raw);
                    const real w = alpha * t;
                    const real light = dot(colour.xyz, g.xyz) + colour.w * gz;
                    seen += w * light;
                    const real grad_alpha = t * light - (g.w - seen) / (1 - alpha);
                    const real grad_raw = grad_alpha * cut_alpha_slope(raw);
                    const real grad_power = grad_raw * raw;
                    s_colour += w * g.xyz;
                    s_z += w * gz;
                    s_opacity += grad_raw * e;
                    s_x += grad_power * dx;
                    s_y += grad_power * dy;
                    s_xx += grad_power * dx * dx;
                    s_xy += grad_power * dx * dy;
                    s_yy += grad_power * dy * dy;
                    t -= w;
                }
            }
        }
    }
    if (valid) {
        __global real *sum = pair_grads + (ulong)emission_indices[own] * SUMS;
        vstore3(s_colour, 0, sum);
        sum[SUM_OPACITY] = s_opacity;
        sum[SUM_X] = s_x;
        sum[SUM_Y] = s_y;
        sum[SUM_XX] = s_xx;
        sum[SUM_XY] = s_xy;
        sum[SUM_YY] = s_yy;
#if WITH_DEPTH
        sum[SUM_DEPTH] = s_z;
#endif
    }
}

// An element is a splat's column.
__kernel void sum_pairs(uint carried, __global const uint *restrict counts,
                        __global const uint *restrict splat_counts,
                        __global const uint *restrict offsets,
                        __global const real *restrict pair_grads, __global real *restrict totals)
{
    FOR_EACH(i, (ulong)counts[COUNT_VISIBLE] * SUMS) {
        const ulong v = i / SUMS, begin = offsets[v], end = begin + splat_counts[v];
        real total = carried ? totals[i] : 0;
        for (ulong index = begin; index < end; index++)
            total += pair_grads[index * SUMS + i % SUMS];
        totals[i] = total;
    }
}
