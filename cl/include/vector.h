// How much a work-item does at once: a scalar (group form) or a row of 16 pixels (item form).
// vreal: that width; vmask: what comparing two of them gives.
#if FORM_ITEM
typedef real16 vreal;
typedef mask16 vmask;
#define TO_MASK convert_mask16
#define AS_INTS as_int16
#define AS_VREAL as_float16
#define VREAL_WIDTH 16 // numbers of a vreal
#define LOAD(P) vload16(0, P)
#define STORE(VALUE, P) vstore16(VALUE, 0, P)
#define ANY(MASK) any(MASK)
#define STORE_MASK(MASK, P) vstore16(convert_int16(MASK), 0, P)
#define IOTA (real16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#else
typedef real vreal;
#if REAL_IS_DOUBLE
typedef long vmask;
#else
typedef int vmask;
#endif
#define VREAL_WIDTH 1
#define LOAD(P) LOAD_ONE(0, P)
#define STORE(VALUE, P) STORE_ONE(VALUE, 0, P)
#define ANY(MASK) (MASK)
#define STORE_MASK(MASK, P) (*(P) = (MASK))
#define TO_MASK (vmask)
#define AS_INTS as_int
#define AS_VREAL as_float
#endif

// In macros over the width: one element, as vload16 and vstore16 take 16.
#define LOAD_ONE(OFFSET, P) (*(P))
#define STORE_ONE(VALUE, OFFSET, P) (*(P) = (VALUE))
