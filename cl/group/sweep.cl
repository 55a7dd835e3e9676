// Group form of sweep.cl (see there): GPUs have no registers for the 49 values of a window. They
// read them again from their caches, in loops of one value a round.
typedef struct {
    __global const real2 *image; // from its first pixel on
    real mean, variance;
} Window;
#define WINDOW_VALUE(window, tap, place) ((window)->image[place].x - (window)->mean)
#define FOR_WINDOW(row, column, stride)                                                            \
    _Pragma("unroll 1") for (int row = 0; row < SIDE; row += (stride))                             \
        _Pragma("unroll 1") for (int column = 0; column < SIDE; column += (stride))

INLINE void load_window(Window *window, __global const real2 *restrict image, int width, int x,
                        int y, int stride)
{
    const int taps = TAPS(stride);
    real sum = 0, squares = 0;
    window->image = image + (y - REACH) * width + x - REACH;
    FOR_WINDOW(row, column, stride)
        sum += window->image[row * width + column].x;
    window->mean = sum / taps;
    FOR_WINDOW(row, column, stride) {
        const real value = WINDOW_VALUE(window, tap, row * width + column);
        squares += value * value;
    }
    window->variance = squares / taps;
}
