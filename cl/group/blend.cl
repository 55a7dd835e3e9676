// Group form of blend.cl (see there), for GPUs. Forward, a group owns a tile, a lane a pixel;
// splats are staged in local memory and each wave walks those that reach its sub-tile; T and C of
// every pixel are noted once a bucket of BUCKET pairs. Adjoint, a group owns a bucket: its lanes
// own the tile's pixels, continue (T, C) from the bucket's beginning and walk its splats front to
// back; then a lane, or four, add up one of a splat's sums over all lanes, through local memory, in
// a fixed order.
#include "subtiles.h"
#define ROW_OF(INDEX) ((__global const real4 *)splats + (ulong)(INDEX) * (SPLAT_REALS / 4))
#if BUCKET % 32 || ADJOINT_GROUP % WAVE || TILE * TILE % ADJOINT_GROUP
#error "BUCKET is a multiple of 32, ADJOINT_GROUP one of WAVE and a divisor of a tile's pixels"
#endif
#define WORDS (PIXELS / 32) // of a bit mask with a bit a staged splat

// Of a sub-tile that an ellipse reaches, some pixel nearly always is inside, so no pixel branches:
// those outside have weight zero. Division is native where it was seen accurate.
#ifndef NATIVE_DIVIDE
#define NATIVE_DIVIDE (HAVE_NATIVE_DIVIDE && !REAL_IS_DOUBLE)
#endif
#if NATIVE_DIVIDE
#define DIVIDE(A, B) native_divide(A, B)
#else
#define DIVIDE(A, B) ((A) / (B))
#endif
#ifndef AT_ONCE // splats whose alphas a lane computes before it blends them: none waits for another
#define AT_ONCE 2
#endif
#ifndef TOGETHER // splats whose sums the adjoint adds up at once; larger groups need the memory
#define TOGETHER (ADJOINT_GROUP > 64 ? 1 : ADJOINT_GROUP / SUMS < 3 ? ADJOINT_GROUP / SUMS : 3)
#endif
#define PARTS (ADJOINT_GROUP >= 4 * TOGETHER * SUMS ? 4 : 1) // lanes that add up a sum

// The staged columns of a splat, scaled so that the power, for base two, is k.x dx^2 + k.y dx dy +
// k.z dy^2, and is to be at least s.w.
inline real4 staged_shape(real4 shape)
{
    return (real4)(shape.xyz, (real)(-0.5 * LOG2_E) * shape.w);
}

inline real4 staged_conic(real4 conic)
{
    return (real)(-0.5 * LOG2_E) * (real4)(conic.x, 2 * conic.y, conic.z, 0);
}

// The colours of a splat and its depth.
inline ColourAnd staged_colour(__global const real4 *splat, __global const real *colours)
{
    Colour colour;
#define OF_SPLAT(C) colours[C]
    LOAD_COLOUR(colour, OF_SPLAT);
    return colour_and(colour, splat[2].w);
}

// The depth channel after a splat of weight w, before which the transmittance was t.
inline real with_depth(real z, real depth, real w, real t)
{
    return DEPTH_PERCENT ? (w > 0 && t > (real)DEPTH_AT ? depth : z) : z + w * depth;
}

// Forward and adjoint must agree on each bit of the power, so its operations are spelled out; the
// first two are of a column of pixels.
#define POWER_XX(K, DX) ((K).x * (DX) * (DX))
#define POWER_X(K, DX) ((K).y * (DX))
#define POWER(K, XX, X, DY) MAD(MAD((K).z, DY, X), DY, XX)

// Channels of a pixel.
#define NOTHING(C) 0
#define IMAGE(C) image[(C)*plane + pixel]
#define GRAD_IMAGE(C) grad_image[(C)*plane + pixel]
#define BACKGROUND(C) background[C]
#define STORE_IMAGE(C, VALUE) IMAGE(C) = VALUE
#define SET_SEEN(C, VALUE) seen[C] = VALUE

// Checkpoints: real[buckets, PIXELS, CHANNELS + 1] of (C, T) and, with depth, real[buckets, PIXELS]
// of depth, by slots; of pixels that had not ended before the bucket.
__kernel __attribute__((reqd_work_group_size(PIXELS, 1, 1)))
void blend(BLEND_ARGUMENTS, __global const uint *restrict bucket_offsets,
           __global real *restrict checkpoints DEPTH_ARGUMENT(depth_checkpoints))
{
    __local real4 shape[PIXELS], conic[PIXELS];
    __local ColourAnd colour[PIXELS];   // and depth
    __local uchar reached[PIXELS];      // sub-tiles of a splat
    __local uint hits[SUBTILES][WORDS]; // splats of a sub-tile, the first in the highest bit
    __local int open;
    const int tile = get_group_id(0), lane = get_local_id(0), place = first_tile + tile;
    const int tiles_x = TILES_X;
    const int x0 = place % tiles_x * TILE, y0 = place / tiles_x * TILE;
    const int column = x0 + slot_column(lane), row = y0 + slot_row(lane);
    const bool inside = column < width && row < height;
    const uint begin = ranges[2 * tile], end = ranges[2 * tile + 1];
    const uint first_bucket = bucket_offsets[tile];
    const real x = column + 0.5, y = row + 0.5;
    real t = 1, z = 0;
    Colour c;
    LOAD_COLOUR(c, NOTHING);
    int latest = -1;
    bool done = !inside;
    for (uint base = begin; base < end; base += PIXELS) {
        if (lane == 0)
            open = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (!done)
            open = 1; // every writer writes the same
        uint own_reached = 0;
        if (base + lane < end) {
            const uint index = sorted_splats[base + lane];
            __global const real4 *splat = ROW_OF(index);
            const real4 s = splat[0], k = splat[1];
            shape[lane] = staged_shape(s);
            conic[lane] = staged_conic(k);
            colour[lane] = staged_colour(splat, COLOURS_OF(splat, index));
            own_reached = reached_subtiles(ellipse_from(s, k), x0, y0);
        }
        reached[lane] = own_reached;
        barrier(CLK_LOCAL_MEM_FENCE);
        if (!open) // read by all after a barrier: the group leaves together
            break;
        if (lane < SUBTILES * WORDS) {
            const int subtile = lane / WORDS, first = lane % WORDS * 32;
            uint bits = 0;
            for (int i = 0; i < 32; i++)
                bits = bits << 1 | (reached[first + i] >> subtile & 1);
            hits[subtile][lane % WORDS] = bits;
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint word = 0; word < WORDS && base + word * 32 < end; word++) {
            if (done) // before the barrier that follows: lanes come together again
                break;
            const uint past = base - begin + word * 32;
            if (past % BUCKET == 0) {
                const ulong slot = (ulong)(first_bucket + past / BUCKET) * PIXELS + lane;
                ((__global ColourAnd *)checkpoints)[slot] = colour_and(c, t);
                IF_DEPTH(depth_checkpoints[slot] = z;)
            }
            uint bits = hits[lane / WAVE][word];
            while (bits && !done) {
                int j[AT_ONCE];
                bool live[AT_ONCE];
                real alpha[AT_ONCE];
#pragma unroll
                for (int i = 0; i < AT_ONCE; i++) {
                    const int bit = clz(bits); // 32 where none is left
                    bits &= ~(0x80000000u >> bit);
                    j[i] = bit < 32 ? (int)word * 32 + bit : j[0];
                    const real4 s = shape[j[i]], k = conic[j[i]];
                    const real dx = x - s.x, dy = y - s.y;
                    const real power = POWER(k, POWER_XX(k, dx), POWER_X(k, dx), dy);
                    live[i] = bit < 32 && power >= s.w;
                    alpha[i] = cut_alpha(s.z * exp2_where(live[i], power));
                }
#pragma unroll
                for (int i = 0; i < AT_ONCE; i++) {
                    const real w = alpha[i] * t, next = t - w;
                    done = done || next < (real)TRANSMITTANCE_MIN;
                    if (!done) {
                        c = scaled_sum(c, w, colour_in(colour[j[i]]));
                        IF_DEPTH(z = with_depth(z, other_in(colour[j[i]]), w, t);)
                        t = next;
                        latest = live[i] ? base + j[i] : latest;
                    }
                }
            }
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    if (inside) {
        const long plane = (long)width * height, pixel = (long)row * width + column;
        Colour behind;
        LOAD_COLOUR(behind, BACKGROUND);
        c = scaled_sum(c, t, behind);
        EACH_COMPONENT(STORE_IMAGE, c);
        IF_RESPONSE(
            Response response;
            LOAD_RESPONSE(response);
            real seen[3];
            EACH_COMPONENT(SET_SEEN, c);
            respond(&response, RADIUS(, response, x, y), seen);
            EACH_CHANNEL(exposed[channel * plane + pixel] = seen[channel];))
        transmittance[pixel] = t;
        last_contributor[pixel] = latest;
        IF_DEPTH(depth[pixel] = z;)
    }
}

#define OWNED (PIXELS / ADJOINT_GROUP) // pixels of a lane
#define STRIDE (ADJOINT_GROUP / WAVE)  // sub-tiles from one of them to the next
#define OWNED_X (STRIDE < SUBTILES_X ? SUBTILES_X / STRIDE : 1) // columns of them
#define OWNED_Y (OWNED / OWNED_X)                               // and rows
#ifndef ROWS_AT_ONCE // sub-tiles, one below the other, that are skipped together or not
#define ROWS_AT_ONCE (OWNED_Y > 1 ? 2 : 1)
#endif
#define ADDED (ADJOINT_GROUP / 4) // vectors of a sum
inline real sum_of(real4 v)
{
    return (v.x + v.y) + (v.z + v.w);
}
#if TOGETHER * SUMS > ADJOINT_GROUP
#error "too many sums for the lanes"
#endif

__kernel __attribute__((reqd_work_group_size(ADJOINT_GROUP, 1, 1)))
void blend_adjoint(BLEND_ADJOINT_ARGUMENTS, __global const uint *restrict counts,
                   __global const uint *restrict bucket_offsets,
                   __global const uint *restrict bucket_tiles, __global const real *restrict image,
                   __global const real *restrict checkpoints DEPTH_INPUT(depth)
                   DEPTH_INPUT(depth_checkpoints))
{
    __local real4 shape[BUCKET], conic[BUCKET];
    __local ColourAnd colour[BUCKET];
    __local real4 sums[TOGETHER * SUMS][ADDED + 1]; // + 1: rows begin in other banks
    __local uint emission[BUCKET];
    __local uchar reached[BUCKET];
    __local uint open_subtiles;
    const uint bucket = get_group_id(0), tile = bucket_tiles[bucket];
    if (bucket >= counts[COUNT_BUCKETS]) // the launch is an upper bound; the whole group leaves
        return;
    const int lane = get_local_id(0), place = first_tile + tile, tiles_x = TILES_X;
    const int x0 = place % tiles_x * TILE, y0 = place / tiles_x * TILE;
    const long plane = (long)width * height;
    const int first = ranges[2 * tile] + (bucket - bucket_offsets[tile]) * BUCKET;
    const int count = min(BUCKET, (int)ranges[2 * tile + 1] - first);
    if (lane == 0)
        open_subtiles = 0;
    barrier(CLK_LOCAL_MEM_FENCE);

    int last[OWNED];
    uint own_open = 0;
#pragma unroll
    for (int i = 0; i < OWNED; i++) {
        const int slot = i * ADJOINT_GROUP + lane;
        const int column = x0 + slot_column(slot), row = y0 + slot_row(slot);
        last[i] = -1;
        if (column < width && row < height)
            last[i] = last_contributor[(long)row * width + column];
        own_open |= (uint)(last[i] >= first) << slot / WAVE;
    }
    if (own_open)
        atomic_or(&open_subtiles, own_open);
    barrier(CLK_LOCAL_MEM_FENCE);

    const uint open = open_subtiles;
    real x[OWNED_X], y[OWNED_Y];
#pragma unroll
    for (int i = 0; i < OWNED_X; i++)
        x[i] = x0 + slot_column(i * ADJOINT_GROUP + lane) + 0.5;
#pragma unroll
    for (int i = 0; i < OWNED_Y; i++)
        y[i] = y0 + slot_row(i * OWNED_X * ADJOINT_GROUP + lane) + 0.5;
    uint blocks[OWNED / ROWS_AT_ONCE]; // bit masks of the sub-tiles in each
#pragma unroll
    for (int block = 0; block < OWNED / ROWS_AT_ONCE; block++) {
        blocks[block] = 0;
        for (int part = 0; part < ROWS_AT_ONCE; part++) {
            const int i = (block / OWNED_X * ROWS_AT_ONCE + part) * OWNED_X + block % OWNED_X;
            blocks[block] |= 1u << (i * STRIDE + (STRIDE > 1 ? lane / WAVE : 0));
        }
    }
    // in front of the splat: transmittance; cotangent . all from there on
    real t[OWNED], rest[OWNED];
    Colour grad[OWNED];
    IF_DEPTH(real grad_z[OWNED];)
#pragma unroll
    for (int i = 0; i < OWNED; i++) {
        t[i] = rest[i] = 0;
        LOAD_COLOUR(grad[i], NOTHING);
        IF_DEPTH(grad_z[i] = 0;)
        if (!open)
            continue;
        // no branch by pixel, so that all loads are under way at once; what has ended reads pixel 0
        const int slot = i * ADJOINT_GROUP + lane;
        const bool live = last[i] >= first;
        const long pixel =
            live ? (long)(y0 + slot_row(slot)) * width + x0 + slot_column(slot) : 0;
        const ColourAnd before =
            ((__global const ColourAnd *)checkpoints)[(ulong)bucket * PIXELS + slot];
        Colour all, cotangent;
        LOAD_COLOUR(all, IMAGE);
        LOAD_COLOUR(cotangent, GRAD_IMAGE);
        real behind = dot_colours(cotangent, scaled_sum(all, -1, colour_in(before)));
        IF_DEPTH(
            const real before_z = depth_checkpoints[(ulong)bucket * PIXELS + slot];
            const real cotangent_z = grad_depth[pixel];
            behind += cotangent_z * (depth[pixel] - before_z);
            behind += grad_transmittance[pixel] * transmittance[pixel];
            if (live)
                grad_z[i] = cotangent_z;)
        if (live) {
            grad[i] = cotangent;
            t[i] = other_in(before);
            rest[i] = behind;
        }
    }
    for (int j = lane; j < count; j += ADJOINT_GROUP) {
        emission[j] = emission_indices[first + j];
        if (open) {
            const uint index = sorted_splats[first + j];
            __global const real4 *splat = ROW_OF(index);
            const real4 s = splat[0], k = splat[1];
            shape[j] = staged_shape(s);
            conic[j] = staged_conic(k);
            colour[j] = staged_colour(splat, COLOURS_OF(splat, index));
            reached[j] = open & reached_subtiles(ellipse_from(s, k), x0, y0);
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (!open)
        for (int j = lane; j < count * SUMS; j += ADJOINT_GROUP)
            pair_grads[(ulong)emission[j / SUMS] * SUMS + j % SUMS] = 0;
    const int todo = open ? count : 0;
    for (int base = 0; base < todo; base += TOGETHER) {
        for (int j = base; j < min(base + TOGETHER, todo); j++) {
            const real4 s = shape[j], k = conic[j];
            const ColourAnd light_of = colour[j];
            const uint hit = reached[j];
            Colour s_colour;
            LOAD_COLOUR(s_colour, NOTHING);
            real s_opacity = 0, s_x = 0, s_y = 0, s_xx = 0, s_xy = 0, s_yy = 0;
            IF_DEPTH(real s_z = 0;)
            real dx[OWNED_X], power_x[OWNED_X], power_xx[OWNED_X];
#pragma unroll
            for (int i = 0; i < OWNED_X; i++) {
                dx[i] = x[i] - s.x;
                power_x[i] = POWER_X(k, dx[i]);
                power_xx[i] = POWER_XX(k, dx[i]);
            }
#pragma unroll
            for (int block = 0; block < OWNED / ROWS_AT_ONCE; block++) {
                const int column = block % OWNED_X, top = block / OWNED_X * ROWS_AT_ONCE;
                if (!(hit & blocks[block]))
                    continue;
#pragma unroll
                for (int row = top; row < top + ROWS_AT_ONCE; row++) {
                    const int i = row * OWNED_X + column;
                    const real dy = y[row] - s.y;
                    const real power = POWER(k, power_xx[column], power_x[column], dy);
                    const bool live = power >= s.w && first + j <= last[i];
                    const real e = exp2_where(live, power), raw = s.z * e;
                    const real alpha = cut_alpha(raw), w = alpha * t[i];
                    real light = dot_colours(colour_in(light_of), grad[i]);
                    IF_DEPTH(light += other_in(light_of) * grad_z[i]; s_z += w * grad_z[i];)
                    rest[i] -= w * light;
                    const real grad_alpha = t[i] * light - DIVIDE(rest[i], 1 - alpha);
                    const real grad_raw = grad_alpha * cut_alpha_slope(raw);
                    const real grad_power = grad_raw * raw;
                    const real by_x = grad_power * dx[column], by_y = grad_power * dy;
                    s_colour = scaled_sum(s_colour, w, grad[i]);
                    s_opacity += grad_raw * e;
                    s_x += by_x;
                    s_y += by_y;
                    s_xx += by_x * dx[column];
                    s_xy += by_x * dy;
                    s_yy += by_y * dy;
                    t[i] -= w;
                }
            }
#define KEEP(SUM, VALUE) ((__local real *)sums[(j - base) * SUMS + (SUM)])[lane] = (VALUE)
#define KEEP_COLOUR(C, VALUE) KEEP(SUM_COLOUR + (C), VALUE)
            EACH_COMPONENT(KEEP_COLOUR, s_colour);
            KEEP(SUM_OPACITY, s_opacity);
            KEEP(SUM_X, s_x);
            KEEP(SUM_Y, s_y);
            KEEP(SUM_XX, s_xx);
            KEEP(SUM_XY, s_xy);
            KEEP(SUM_YY, s_yy);
            if (CHANNELS == 1)
                KEEP(SUM_COLOUR + 1, 0); // of no channel
            IF_DEPTH(KEEP(SUM_DEPTH, s_z);)
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        const int rows = min(TOGETHER, todo - base) * SUMS;
        real total = 0;
        if (lane < rows * PARTS) {
            __local const real4 *part = sums[lane / PARTS] + lane % PARTS * (ADDED / PARTS);
            real4 four = part[0];
            for (int i = 1; i < ADDED / PARTS; i++)
                four += part[i];
            total = sum_of(four);
        }
        if (PARTS > 1) { // the sums of parts fill the end of a row, which nobody reads before
            if (lane < rows * PARTS)
                ((__local real *)&sums[lane / PARTS][ADDED])[lane % PARTS] = total;
            barrier(CLK_LOCAL_MEM_FENCE);
            if (lane < rows)
                total = sum_of(sums[lane][ADDED]);
        }
        if (lane < rows)
            pair_grads[(ulong)emission[base + lane / SUMS] * SUMS + lane % SUMS] = total;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
}
