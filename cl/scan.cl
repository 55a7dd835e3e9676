// Exclusive prefix sum of uint values, reduce-then-scan in chunks; integer, hence deterministic.
//
//   offsets[i] = values[0] + ... + values[i-1]
//   totals[c] = sum of chunk c, totals[chunks] = sum of all, in 64 bits
//
// values, offsets: uint[N]; totals: ulong[chunks + 1]. Every chunk adds up the totals before it:
// that takes less than one more launch. Offsets are 32-bit: the caller must refuse a total past
// 2^32.

#if FORM_ITEM
#include "item/scan.cl"
#else
#include "group/scan.cl"
#endif
