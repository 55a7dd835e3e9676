// Where the harmonics above the constant of a row and their moments lie. In builds with PAGED they
// lie in pages of PAGE_ROWS rows, of which some are on the device (pages.cl). places: uint[N], the
// place of a row in the order of all pages; slots: uint[pages], where a page is on the device, in
// pages, with PAGE_ABSENT where another has its slot.
#if PAGED
#define REST_ARGUMENTS , __global const uint *restrict places, __global const uint *restrict slots
#define REST_PASSED , places, slots
inline bool has_rest(uint row, __global const uint *places, __global const uint *slots)
{
    return !(slots[places[row] / PAGE_ROWS] & PAGE_ABSENT);
}
inline ulong rest_row(uint row, __global const uint *places, __global const uint *slots)
{
    const uint place = places[row];
    return (ulong)(slots[place / PAGE_ROWS] & ~PAGE_ABSENT) * PAGE_ROWS + place % PAGE_ROWS;
}
#else
#define REST_ARGUMENTS
#define REST_PASSED
inline bool has_rest(uint row)
{
    return true;
}
inline ulong rest_row(uint row)
{
    return row;
}
#endif
#define HAS_REST(row) has_rest(row REST_PASSED)
#define REST_ROW(row) rest_row(row REST_PASSED)
