// Stable radix sort of (uint key, uint value) by one digit of DIGIT_BITS bits; called once a digit,
// least significant first: count digits a part, scatter. Written for few work-items, each of which
// walks a part of the keys in order; the group form of binning needs no such sort (bin.cl).
//
// keys, values: uint[R], of which the first counts[COUNT_VISIBLE] count; table: uint[parts,
// digits]. In the first pass (`first` is 1) the values are the positions themselves, so that a
// permutation results. Integer only, one writer a slot: deterministic.
#include "each.h"
#define DIGITS (1u << DIGIT_BITS)
#define DIGIT(key) (((key) >> shift) & (DIGITS - 1))

__kernel void sort_count(uint parts, uint shift, __global const uint *restrict counts,
                         __global const uint *restrict keys, __global uint *restrict table)
{
    FOR_EACH(part, parts) {
        __global uint *own = table + part * DIGITS;
        const ulong count = counts[COUNT_VISIBLE];
        const uint begin = count * part / parts, end = count * (part + 1) / parts;
        for (uint d = 0; d < DIGITS; d++)
            own[d] = 0;
        for (uint i = begin; i < end; i++)
            own[DIGIT(keys[i])]++;
    }
}

__kernel void sort_scatter(uint parts, uint shift, uint first, __global const uint *restrict counts,
                           __global const uint *restrict keys, __global const uint *restrict values,
                           __global const uint *restrict table, __global uint *restrict sorted_keys,
                           __global uint *restrict sorted_values)
{
    FOR_EACH(part, parts) {
        const ulong count = counts[COUNT_VISIBLE];
        const uint begin = count * part / parts, end = count * (part + 1) / parts;
        uint next[DIGITS], place = 0;
        for (uint d = 0; d < DIGITS; d++) {
            for (uint other = 0; other < parts; other++) {
                if (other == part)
                    next[d] = place;
                place += table[other * DIGITS + d];
            }
        }
        for (uint i = begin; i < end; i++) {
            const uint key = keys[i], slot = next[DIGIT(key)]++;
            sorted_keys[slot] = key;
            sorted_values[slot] = first ? i : values[i];
        }
    }
}
