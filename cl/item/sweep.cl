// Item form of sweep.cl (see there): a window keeps its values.
typedef struct {
    real values[SIDE * SIDE];
    real mean, variance;
} Window;
#define WINDOW_VALUE(window, tap, place) (window)->values[tap]
#define FOR_WINDOW(row, column, stride)                                                            \
    for (int row = 0; row < SIDE; row += (stride))                                                 \
        for (int column = 0; column < SIDE; column += (stride))

INLINE void load_window(Window *window, __global const real2 *restrict image, int width, int x,
                        int y, int stride)
{
    const int taps = TAPS(stride);
    real sum = 0, squares = 0;
    int tap = 0;
    FOR_WINDOW(row, column, stride) {
        const real value = image[(y + row - REACH) * width + x + column - REACH].x;
        window->values[tap++] = value;
        sum += value;
    }
    for (tap = 0; tap < taps; tap++) {
        window->values[tap] -= sum / taps;
        squares += window->values[tap] * window->values[tap];
    }
    window->mean = sum / taps;
    window->variance = squares / taps;
}
