// Stable radix sort of (uint key, uint value) by one digit of DIGIT_BITS bits; called once a digit,
// least significant first. Count digits a chunk, scan the table digit-major (scan.cl), scatter.
//
// keys, values: uint[N]; table: uint[digits * chunks], entry [digit * chunks + chunk]. In the first
// pass (`first` is 1) the values are the positions themselves, so that a permutation results.
// Integer only, one writer a slot: deterministic.

#ifndef DIGIT_BITS
#error "DIGIT_BITS must be defined"
#endif
#define DIGITS (1u << DIGIT_BITS)
#define DIGIT(key) (((key) >> shift) & (DIGITS - 1))

#if FORM_ITEM
#include "item/sort.cl"
#else
#include "group/sort.cl"
#endif
