// Item form of match.cl (see there): a work-item owns 16 features of a pair, or one.

#define LISTED 256

// The best of 16 columns, which took turns at the features of the other photo.
INLINE void best_of(real16 first, real16 second, int16 block, __global int *nearest,
                    __global real *products)
{
    real firsts[16], seconds[16];
    int blocks[16];
    vstore16(first, 0, firsts);
    vstore16(second, 0, seconds);
    vstore16(block, 0, blocks);
    real best = -1, next = -1;
    int found = -1;
    for (int column = 0; column < 16; column++) {
        const int index = 16 * blocks[column] + column;
        if (firsts[column] > best || (firsts[column] == best && index < found)) {
            next = fmax(next, best);
            best = firsts[column];
            found = index;
        } else {
            next = fmax(next, firsts[column]);
        }
        next = fmax(next, seconds[column]);
    }
    *nearest = found;
    products[0] = fmax(best, (real)0);
    products[1] = fmax(next, (real)0);
}

__kernel void nearest(uint blocks, uint pair_count, __global const int *restrict pairs,
                      __global const real *restrict spread, __global int *restrict nearest,
                      __global real *restrict products)
{
    const ulong photo = (ulong)blocks * DESCRIPTOR_SIZE * 16; // elements
    FOR_EACH(i, pair_count * blocks) {
        const int2 pair = vload2(i / blocks, pairs);
        __global const real *own = spread + pair.x * photo + i % blocks * DESCRIPTOR_SIZE * 16;
        for (int query = 0; query < 16; query += 4, own += 4) {
            real16 a_first = -1, b_first = -1, c_first = -1, d_first = -1;
            real16 a_second = -1, b_second = -1, c_second = -1, d_second = -1;
            int16 a_block = 0, b_block = 0, c_block = 0, d_block = 0;
            __global const real *other = spread + pair.y * photo;
            for (int block = 0; block < (int)blocks; block++, other += DESCRIPTOR_SIZE * 16) {
                real16 a = 0, b = 0, c = 0, d = 0;
                for (int k = 0; k < DESCRIPTOR_SIZE; k++) {
                    const real16 values = vload16(k, other);
                    a = MAD((real16)own[16 * k], values, a);
                    b = MAD((real16)own[16 * k + 1], values, b);
                    c = MAD((real16)own[16 * k + 2], values, c);
                    d = MAD((real16)own[16 * k + 3], values, d);
                }
#define KEEP(X)                                                                                    \
    X##_block = select(X##_block, (int16)block, convert_int16(X > X##_first));                     \
    X##_second = fmax(X##_second, fmin(X##_first, X));                                             \
    X##_first = fmax(X##_first, X);
                KEEP(a)
                KEEP(b)
                KEEP(c)
                KEEP(d)
            }
            const ulong at = 16 * i + query;
            best_of(a_first, a_second, a_block, nearest + at, products + 2 * at);
            best_of(b_first, b_second, b_block, nearest + at + 1, products + 2 * at + 2);
            best_of(c_first, c_second, c_block, nearest + at + 2, products + 2 * at + 4);
            best_of(d_first, d_second, d_block, nearest + at + 3, products + 2 * at + 6);
        }
    }
}

// The best two of the features that `candidates` lists, and of those before.
typedef struct {
    real best, next;
    int found;
} BestTwo;

INLINE void compare(const real16 *query, __global const uchar *others, const int *candidates,
                    int count, BestTwo *two)
{
    for (int i = 0; i < count; i++) {
        __global const uchar *other = others + (ulong)candidates[i] * DESCRIPTOR_SIZE;
        real16 sums = 0;
        for (int k = 0; k < DESCRIPTOR_SIZE / 16; k++)
            sums = MAD(query[k], convert_real16(vload16(k, other)), sums);
        const real product = sum16(sums);
        two->next = fmax(two->next, fmin(two->best, product));
        two->found = product > two->best ? candidates[i] : two->found;
        two->best = fmax(two->best, product);
    }
}

__kernel void follow(uint features, uint pair_count, __global const int *restrict pairs,
                     __global const int *restrict counts, __global const real *restrict geometry,
                     __global const real *restrict points,
                     __global const uchar *restrict descriptors, __global int *restrict nearest,
                     __global real *restrict products)
{
    FOR_EACH(i, pair_count * features) {
        const uint row = i / features, feature = i % features;
        const int2 pair = vload2(row, pairs);
        const int count = counts[pair.y];
        BestTwo two = {0, 0, -1};
        if ((int)feature < counts[pair.x]) {
            __global const real *own = points + (ulong)pair.x * 2 * features;
            __global const real *xs = points + (ulong)pair.y * 2 * features, *ys = xs + features;
            __global const uchar *others = descriptors + (ulong)pair.y * features * DESCRIPTOR_SIZE;
            const Allowed allowed = allowed_places(geometry + TWO_VIEW_REALS * row, own[feature],
                                                   own[features + feature]);
            const real most_squared = allowed.most * allowed.most;
            real16 query[DESCRIPTOR_SIZE / 16];
            for (int k = 0; k < DESCRIPTOR_SIZE / 16; k++)
                query[k] = convert_real16(vload16(
                    k, descriptors + ((ulong)pair.x * features + feature) * DESCRIPTOR_SIZE));
            int candidates[LISTED + 16],
                listed = 0; // without branches, which would be guessed wrong
            for (int first = 0; first < count; first += 16) {
                const real16 x = vload16(0, xs + first), y = vload16(0, ys + first);
                real16 away_squared;
                AWAY_SQUARED(real16, allowed, x, y, away_squared)
                const mask16 near = away_squared <= most_squared;
                if (!any(near))
                    continue;
                int lanes[16];
                vstore16(convert_int16(near), 0, lanes);
                for (int lane = 0; lane < 16; lane++) {
                    candidates[listed] = first + lane;
                    listed -= lanes[lane] & -(first + lane < count);
                }
                if (listed >= LISTED) {
                    compare(query, others, candidates, listed, &two);
                    listed = 0;
                }
            }
            compare(query, others, candidates, listed, &two);
        }
        nearest[i] = two.found;
        vstore2((real2)(two.best, two.next), i, products);
    }
}
