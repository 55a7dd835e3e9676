// Item form of sift.cl (see there): a work-item owns a row, or a keypoint.

// Rows of `smoothed` into an image of `levels`, and its difference to the image `before`.
__kernel void smooth_rows(uint width, uint height, uint stride, uint before, uint target,
                          uint difference, uint radius, __global const real *restrict taps,
                          __global real *restrict smoothed, __global real *restrict levels,
                          __global real *restrict differences)
{
    FOR_EACH(y, height) {
        __global real *row = smoothed + y * (stride + 2 * SIFT_PADDING) + SIFT_PADDING;
        for (int x = 0; x < SIFT_PADDING; x++)
            row[x - SIFT_PADDING] = row[0];
        for (int x = width; x < (int)stride + SIFT_PADDING; x++)
            row[x] = row[width - 1];
        for (uint x = 0; x < stride; x += 16) {
            real16 sum = taps[0] * vload16(0, row + x);
            for (int tap = 1; tap <= (int)radius; tap++)
                sum = MAD((real16)taps[tap], vload16(0, row + x - tap) + vload16(0, row + x + tap),
                          sum);
            const uint at = y * stride + x;
            vstore16(sum, 0, levels + target + at);
            vstore16(sum - vload16(0, levels + before + at), 0,
                     differences + SIFT_PADDING + difference + at);
        }
    }
}

// Rows of samples follow each other, with PATCH - SAMPLES columns of no use between them.
#define ROW_SAMPLES ((SAMPLES * PATCH + 15) / 16 * 16)

// Samples of a grid, then length and direction (from 0 to `bins`) of their gradients, which count
// less the farther they are from the middle.
INLINE void gradients(Surroundings from, real spacing, real angle, real sigma, int bins,
                      real *lengths, real *directions)
{
    real patch[ROW_SAMPLES + 2 * PATCH], weights[SAMPLES];
    const real cosine = cos(angle), sine = sin(angle);
    for (int index = 0; index < PATCH * PATCH; index++)
        patch[index] = patch_sample(from, index, spacing, cosine, sine);
    for (int index = PATCH * PATCH; index < ROW_SAMPLES + 2 * PATCH; index++)
        patch[index] = 0;
    for (int index = 0; index < ROW_SAMPLES; index += 16) {
        const real *at = patch + PATCH + 1 + index;
        const real16 dx = vload16(0, at + 1) - vload16(0, at - 1);
        const real16 dy = vload16(0, at + PATCH) - vload16(0, at - PATCH);
        const real16 turn = atan2(dy, dx) * (real)(bins / TAU);
        vstore16(sqrt(dx * dx + dy * dy), 0, lengths + index);
        vstore16(select(turn, turn + bins, turn < 0), 0, directions + index);
    }
    for (int index = 0; index < SAMPLES; index++)
        weights[index] = gaussian_of(index, sigma);
    for (int row = 0; row < SAMPLES; row++)
        for (int column = 0; column < SAMPLES; column++)
            lengths[row * PATCH + column] *= weights[row] * weights[column];
}

INLINE real2 orientations(Surroundings from)
{
    real lengths[ROW_SAMPLES], directions[ROW_SAMPLES], turns[TURNS];
    gradients(from, ORIENTATION_SPACING, 0, ORIENTATION_SIGMA, TURNS, lengths, directions);
    for (int bin = 0; bin < TURNS; bin++)
        turns[bin] = 0;
    for (int row = 0; row < SAMPLES; row++)
        for (int at = row * PATCH; at < row * PATCH + SAMPLES; at++) {
            const int bin = (int)directions[at] % TURNS;
            const real share = directions[at] - (int)directions[at];
            turns[bin] += (1 - share) * lengths[at];
            turns[(bin + 1) % TURNS] += share * lengths[at];
        }
    return peaks(turns);
}

INLINE void describe_one(Surroundings from, real angle, __global uchar *descriptor)
{
    real lengths[ROW_SAMPLES], directions[ROW_SAMPLES];
    real cells[6 * 6 * DIRECTIONS]; // one more on each side, whose share is not used
    gradients(from, DESCRIPTOR_SPACING, angle, DESCRIPTOR_SIGMA, DIRECTIONS, lengths, directions);
    for (int index = 0; index < 6 * 6 * DIRECTIONS; index++)
        cells[index] = 0;
    for (int row = 0; row < SAMPLES; row++) {
        const real v = (row - MIDDLE) / CELL + (real)2.5, down = v - (int)v;
        for (int column = 0; column < SAMPLES; column++) {
            const real length = lengths[row * PATCH + column],
                       turn = directions[row * PATCH + column];
            const real u = (column - MIDDLE) / CELL + (real)2.5, right = u - (int)u;
            const int bin = (int)turn % DIRECTIONS, next = (bin + 1) % DIRECTIONS;
            const real on = turn - (int)turn;
            real *upper = cells + ((int)v * 6 + (int)u) * DIRECTIONS,
                 *lower = upper + 6 * DIRECTIONS;
#define ADD(CELL_OF, SHARE)                                                                        \
    (CELL_OF)[bin] += (SHARE) * (1 - on) * length;                                                 \
    (CELL_OF)[next] += (SHARE) * on * length;
            ADD(upper, (1 - down) * (1 - right))
            ADD(upper + DIRECTIONS, (1 - down) * right)
            ADD(lower, down * (1 - right))
            ADD(lower + DIRECTIONS, down * right)
        }
    }
    // clipped and of length 1, then the root of each share
    real clipped = 0, squares = 0, values[DESCRIPTOR_SIZE];
    for (int index = 0; index < DESCRIPTOR_SIZE; index++) {
        values[index] = cells[((index / 32 + 1) * 6 + index / 8 % 4 + 1) * DIRECTIONS + index % 8];
        squares += values[index] * values[index];
    }
    const real limit = (real)MOST_OF_ONE * sqrt(squares);
    for (int index = 0; index < DESCRIPTOR_SIZE; index++)
        clipped += fmin(values[index], limit);
    const real scale = clipped > 0 ? 1 / clipped : 0;
    for (int index = 0; index < DESCRIPTOR_SIZE; index++)
        descriptor[index] = convert_uchar_sat_rte(512 * sqrt(fmin(values[index], limit) * scale));
}

__kernel void describe(uint count, __global const real *restrict keypoints,
                       __global const int *restrict octaves, __global const real *restrict levels,
                       __global real *restrict angles, __global uchar *restrict descriptors)
{
    FOR_EACH(keypoint, count) {
        const Surroundings from = surroundings(keypoint, keypoints, octaves, levels);
        const real2 found = orientations(from);
        vstore2(found, keypoint, angles);
        if (found.x > NO_ANGLE)
            describe_one(from, found.x, descriptors + 2 * DESCRIPTOR_SIZE * keypoint);
        if (found.y > NO_ANGLE)
            describe_one(from, found.y, descriptors + DESCRIPTOR_SIZE * (2 * keypoint + 1));
    }
}
