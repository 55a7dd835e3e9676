// How much a work-item does at once: a scalar (group form) or a row of 16 pixels (item form).
// vreal: that width; vmask: what comparing two of them gives.
#if FORM_ITEM
typedef real16 vreal;
typedef mask16 vmask;
#define TO_MASK convert_mask16
#define AS_INTS as_int16
#define AS_VREAL as_float16
#define IOTA (real16)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15)
#else
typedef real vreal;
#if REAL_IS_DOUBLE
typedef long vmask;
#else
typedef int vmask;
#endif
#define TO_MASK (vmask)
#define AS_INTS as_int
#define AS_VREAL as_float
#endif

// In macros over the width: one element, as vload16 and vstore16 take 16.
#define LOAD_ONE(OFFSET, P) (*(P))
#define STORE_ONE(VALUE, OFFSET, P) (*(P) = (VALUE))
