// Group form of project.cl (see there). The work-items of a group first load what its PROJECT_GROUP
// gaussians have of many numbers together, so that neighbours read neighbouring numbers: a
// work-item that reads a row by itself touches as many lines of the cache as its group has rows,
// for each number.
#define SH_COLUMNS (3 * SH_ACTIVE)
#define SH_STRIDE (SH_COLUMNS | 1) // odd: work-items read from different banks
#define GAUSSIANS_MEMORY                                                                           \
    __local real sh_local[PROJECT_GROUP * SH_STRIDE], sums_local[PROJECT_GROUP * SUMS];
// LOADED: of load_harmonics and load_sums, for the gaussians from `first` on.
// The launch has a work-item for every gaussian. The loop over v says that it has one round: in
// one of several, compilers would keep all that they have read of the camera and of the arguments
// in scalar registers, which are too few. Without the loop around it there would be fewer still,
// but PoCL and Intel's runtime then crash in tests, and why was not found.
#define FOR_EACH_GAUSSIAN(v, count, LOADED)                                                        \
    for (ulong first = get_group_id(0) * (ulong)PROJECT_GROUP;                                     \
         first < (count) && meet() && (LOADED) && meet();                                          \
         first += get_num_groups(0) * (ulong)PROJECT_GROUP)                                        \
        for (ulong v = first + get_local_id(0), end = min(first + PROJECT_GROUP, (ulong)(count));  \
             v < end; v = end)
#define HARMONIC(k) vload3(k, sh_local + get_local_id(0) * SH_STRIDE)
#define SUMS_OF(v, sum) __local const real *sum = sums_local + get_local_id(0) * SUMS
#define LOAD_HARMONICS(count)                                                                      \
    load_harmonics(rows + first, (count) - first, sh_rest, sh_local REST_PASSED)
#define LOAD_SUMS(count)                                                                           \
    load_sums(first, (count) - first, splat_counts, offsets, pair_grads, earlier, sums_local)

inline bool meet(void)
{
    barrier(CLK_LOCAL_MEM_FENCE);
    return true;
}

// The active harmonics of the first PROJECT_GROUP of `count` gaussians.
inline bool load_harmonics(__global const uint *rows, ulong count, __global const real *sh_rest,
                           __local real *sh_local REST_ARGUMENTS)
{
#if DEGREE > 0
    const uint number = min(count, (ulong)PROJECT_GROUP) * SH_COLUMNS;
#pragma unroll 5
    for (uint i = get_local_id(0); i < number; i += PROJECT_GROUP)
        sh_local[i / SH_COLUMNS * SH_STRIDE + i % SH_COLUMNS] =
            sh_rest[REST_ROW(rows[i / SH_COLUMNS]) * (3 * SH_REST) + i % SH_COLUMNS];
#endif
    return true;
}

// The sums over the pairs of the first PROJECT_GROUP of `count` splats from `first` on. Intel's
// compiler would add up several pairs at a time, in an order that depends on their number, so that
// a frame in bands would not have the bytes of one in one piece: its loop is kept in order.
inline bool load_sums(ulong first, ulong count, __global const uint *splat_counts,
                      __global const uint *offsets, __global const real *pair_grads,
                      __global const real *earlier, __local real *sums_local)
{
    const uint number = min(count, (ulong)PROJECT_GROUP) * SUMS;
    for (uint i = get_local_id(0); i < number; i += PROJECT_GROUP) {
        const ulong v = first + i / SUMS, begin = offsets[v], end = begin + splat_counts[v];
        real total = CARRIED ? earlier[first * SUMS + i] : 0;
#pragma clang loop vectorize(disable) interleave(disable)
        for (ulong index = begin; index < end; index++)
            total += pair_grads[index * SUMS + i % SUMS];
        sums_local[i] = total;
    }
    return true;
}
