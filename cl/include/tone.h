// The tone curve of a lens, f(x) = B(a, (1 + B(b, 2 x - 1)) / 2), of one channel's display value
// (clsplat/response.py), from bends of [-1, 1] that keep its ends and its middle,
//
//   B(p, t) = t / (|t| + e^-p (1 - |t|)),  beyond the ends linear with their slope e^-p.
//
// Every bend rises, has the slope e^p at 0, and B(-p, .) is its inverse. Bends are the flow of
// v(t) = t (1 - |t|): dB/dp = v(B), so gradients by p need no derivative of a quotient.
// tones: real[L, TONE_TERMS], rows (a, b). DEFINE_TONE defines, for a scalar or a vector, bend
// with k = e^-p, its slope dB/dt, and v; and with curve = (e^-a, e^-b) the curve and its inverse.

#define DEFINE_TONE(SUFFIX, TYPE)                                                                  \
    inline TYPE bend##SUFFIX(TYPE t, real k)                                                       \
    {                                                                                              \
        const TYPE inside = fmin(fmax(t, (TYPE)-1), (TYPE)1), size = fabs(inside);                 \
        return inside / (size + k * (1 - size)) + k * (t - inside);                                \
    }                                                                                              \
    inline TYPE bend_slope##SUFFIX(TYPE t, real k)                                                 \
    {                                                                                              \
        const TYPE size = fmin(fabs(t), (TYPE)1), below = size + k * (1 - size);                   \
        return k / (below * below);                                                                \
    }                                                                                              \
    inline TYPE bend_speed##SUFFIX(TYPE t)                                                         \
    {                                                                                              \
        const TYPE inside = fmin(fmax(t, (TYPE)-1), (TYPE)1);                                      \
        return inside * (1 - fabs(inside)) + (inside - t);                                         \
    }                                                                                              \
    inline TYPE tone##SUFFIX(TYPE x, const real *curve)                                            \
    {                                                                                              \
        return bend##SUFFIX((real)0.5 * (1 + bend##SUFFIX(2 * x - 1, curve[1])), curve[0]);        \
    }                                                                                              \
    inline TYPE untone##SUFFIX(TYPE y, const real *curve)                                          \
    {                                                                                              \
        return (real)0.5 * (1 + bend##SUFFIX(2 * bend##SUFFIX(y, 1 / curve[0]) - 1,                \
                                             1 / curve[1]));                                       \
    }

// (e^-a, e^-b) of row `lens`.
inline void load_curve(__global const real *tones, uint lens, real *curve)
{
    for (int k = 0; k < TONE_TERMS; k++)
        curve[k] = exp(-tones[lens * TONE_TERMS + k]);
}
