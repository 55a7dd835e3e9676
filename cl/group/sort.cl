// Group form of sort.cl (see there): a group sorts its chunk of GROUP * PER_ITEM keys by the digit in
// local memory (two bits a round), so that writes come in runs.
#define GROUP SCAN_GROUP
#include "group.h"
DEFINE_GROUP_SCAN(group_scan_ulong, ulong)
#define CHUNK (GROUP * PER_ITEM)

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sort_count(uint count, uint chunk, uint chunks, uint shift, __global const uint *restrict keys,
                __global uint *restrict table)
{
    __local uint digits[DIGITS];
    const uint lane = get_local_id(0);
    const uint begin = get_group_id(0) * CHUNK, end = min(begin + CHUNK, count);
    for (uint d = lane; d < DIGITS; d += GROUP)
        digits[d] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = begin + lane; i < end; i += GROUP)
        atomic_inc(&digits[DIGIT(keys[i])]);
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint d = lane; d < DIGITS; d += GROUP)
        table[d * chunks + get_group_id(0)] = digits[d];
}

__kernel __attribute__((reqd_work_group_size(GROUP, 1, 1)))
void sort_scatter(uint count, uint chunk, uint chunks, uint shift, uint first,
                  __global const uint *restrict keys, __global const uint *restrict values,
                  __global const uint *restrict table, __global uint *restrict sorted_keys,
                  __global uint *restrict sorted_values)
{
    __local uint local_keys[CHUNK], local_values[CHUNK];
    __local ulong scratch[GROUP];
    __local uint digit_begin[DIGITS];
    const uint lane = get_local_id(0), begin = get_group_id(0) * CHUNK;
    const uint valid = min((uint)CHUNK, count - begin);
    uint key[PER_ITEM], value[PER_ITEM];

    for (uint i = lane; i < CHUNK; i += GROUP) {
        // keys past the end carry the largest digit; being last, stability keeps them last
        local_keys[i] = i < valid ? keys[begin + i] : UINT_MAX;
        local_values[i] = i < valid ? (first ? begin + i : values[begin + i]) : 0;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint bit = 0; bit < DIGIT_BITS; bit += 2) {
        // a digit of two bits has four counters; 16 bits each hold up to CHUNK
        const uint mask = bit + 1 < DIGIT_BITS ? 3 : 1;
        ulong counts = 0, totals;
        for (uint j = 0; j < PER_ITEM; j++) {
            key[j] = local_keys[lane * PER_ITEM + j];
            value[j] = local_values[lane * PER_ITEM + j];
            counts += 1ul << (16 * ((key[j] >> (shift + bit)) & mask));
        }
        ulong next = group_scan_ulong(counts, scratch, &totals);
        next += (totals << 16) + (totals << 32) + (totals << 48);
        for (uint j = 0; j < PER_ITEM; j++) {
            const uint field = 16 * ((key[j] >> (shift + bit)) & mask);
            const uint slot = (uint)(next >> field) & 0xffff;
            next += 1ul << field;
            local_keys[slot] = key[j];
            local_values[slot] = value[j];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    for (uint i = lane; i < CHUNK; i += GROUP) {
        const uint digit = DIGIT(local_keys[i]);
        if (i == 0 || DIGIT(local_keys[i - 1]) != digit)
            digit_begin[digit] = i;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint i = lane; i < valid; i += GROUP) {
        const uint digit = DIGIT(local_keys[i]);
        const uint slot = table[digit * chunks + get_group_id(0)] + i - digit_begin[digit];
        sorted_keys[slot] = local_keys[i];
        sorted_values[slot] = local_values[i];
    }
}
