// Chunks of consecutive elements: a work-item walks one in the item form, a group of SCAN_GROUP
// items in the group form.
//
// FOR_CHUNK(i, begin, end) { body }: every i once; CHUNK_TOTAL(value): the sum of an integer over
// the chunk, for every item; CHUNK_LEADS: true for the one item that writes what belongs to the
// chunk. CHUNK_SCRATCH declares the memory that CHUNK_TOTAL needs, at the top of a kernel.
#if FORM_ITEM
#define CHUNK_KERNEL __kernel
#define CHUNK_INDEX ((uint)get_global_id(0))
#define CHUNK_LEADS true
#define CHUNK_SCRATCH
#define CHUNK_TOTAL(value) (value)
#define FOR_CHUNK(i, begin, end) for (uint i = (begin); i < (end); i++)
#else
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_GROUP_SCAN(group_scan, uint)
#define CHUNK_KERNEL __kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
#define CHUNK_INDEX ((uint)get_group_id(0))
#define CHUNK_LEADS (get_local_id(0) == 0)
#define CHUNK_SCRATCH __local uint chunk_scratch[GROUP];
#define CHUNK_TOTAL(value) group_total(value, chunk_scratch)
#define FOR_CHUNK(i, begin, end)                                                                   \
    for (uint i##_base = (begin), i = i##_base + get_local_id(0); i##_base < (end);                \
         i##_base += GROUP, i = i##_base + get_local_id(0))                                        \
        if (i < (end))

inline uint group_total(uint value, __local uint *scratch)
{
    uint total;
    group_scan(value, scratch, &total);
    return total;
}
#endif
