// What is blended: the colours of a splat (splat.h), or WITH_FEATURES the features of its gaussian:
// row visible[v] of features: real[N, CHANNELS]. Images and their gradients are real[CHANNELS, H,
// W]. Three channels are spelled out, so that they stay in registers: PoCL would not unroll a loop.
// Other numbers of channels are loops that are unrolled, without which PoCL 3.1 does not finish the
// group form's adjoint.
#ifndef WITH_FEATURES
#define WITH_FEATURES 0
#endif
#if WITH_FEATURES
#define FEATURES_ARGUMENT                                                                          \
    , __global const uint *restrict visible, __global const real *restrict features
#define COLOURS_OF(SPLAT, INDEX) (features + (ulong)visible[INDEX] * CHANNELS)
#else
#define FEATURES_ARGUMENT
#define COLOURS_OF(SPLAT, INDEX) ((__global const real *)(SPLAT) + SPLAT_COLOUR)
#endif

// EACH_CHANNEL writes its argument for every `channel`; ADD_CHANNELS sets TOTAL to the sum of
// TERM(channel).
#if CHANNELS == 3
#define EACH_CHANNEL(BODY) ONE_CHANNEL(0, BODY) ONE_CHANNEL(1, BODY) ONE_CHANNEL(2, BODY)
#define ONE_CHANNEL(K, BODY)                                                                       \
    {                                                                                              \
        const int channel = K;                                                                     \
        BODY                                                                                       \
    }
#define ADD_CHANNELS(TOTAL, TERM) TOTAL = TERM(0) + TERM(1) + TERM(2)
#else
#define EACH_CHANNEL(BODY)                                                                         \
    _Pragma("unroll") for (int channel = 0; channel < CHANNELS; channel++) {                       \
        BODY                                                                                       \
    }
#define ADD_CHANNELS(TOTAL, TERM)                                                                  \
    TOTAL = TERM(0);                                                                               \
    _Pragma("unroll") for (int channel = 1; channel < CHANNELS; channel++)                         \
    TOTAL += TERM(channel)
#endif

// In the group form a pixel's colour is one value, and in memory it has one number beside it.
// LOAD_COLOUR sets a Colour to TERM(channel), EACH_COMPONENT does ACTION(channel, its value).
#if !FORM_ITEM && CHANNELS == 3
typedef real3 Colour;
typedef real4 ColourAnd;
#define LOAD_COLOUR(COLOUR, TERM) COLOUR = (real3)(TERM(0), TERM(1), TERM(2))
#define EACH_COMPONENT(ACTION, COLOUR)                                                             \
    ACTION(0, (COLOUR).x);                                                                         \
    ACTION(1, (COLOUR).y);                                                                         \
    ACTION(2, (COLOUR).z)

inline ColourAnd colour_and(Colour colour, real other)
{
    return (real4)(colour, other);
}

inline Colour colour_in(ColourAnd both)
{
    return both.xyz;
}

inline real other_in(ColourAnd both)
{
    return both.w;
}

inline Colour scaled_sum(Colour colour, real weight, Colour added)
{
    return colour + weight * added;
}

inline real dot_colours(Colour a, Colour b)
{
    return dot(a, b);
}
#elif !FORM_ITEM
typedef struct {
    real of[CHANNELS];
} Colour;
typedef struct {
    Colour colour;
    real other;
} ColourAnd;
#define LOAD_COLOUR(COLOUR, TERM)                                                                  \
    _Pragma("unroll") for (int channel = 0; channel < CHANNELS; channel++)                         \
    (COLOUR).of[channel] = TERM(channel)
#define EACH_COMPONENT(ACTION, COLOUR)                                                             \
    _Pragma("unroll") for (int channel = 0; channel < CHANNELS; channel++)                         \
    ACTION(channel, (COLOUR).of[channel])

INLINE ColourAnd colour_and(Colour colour, real other)
{
    ColourAnd both;
    both.colour = colour;
    both.other = other;
    return both;
}

INLINE Colour colour_in(ColourAnd both)
{
    return both.colour;
}

INLINE real other_in(ColourAnd both)
{
    return both.other;
}

INLINE Colour scaled_sum(Colour colour, real weight, Colour added)
{
    EACH_CHANNEL(colour.of[channel] += weight * added.of[channel];)
    return colour;
}

INLINE real dot_colours(Colour a, Colour b)
{
    real sum = 0;
    EACH_CHANNEL(sum += a.of[channel] * b.of[channel];)
    return sum;
}
#endif
