// Photometric loss and its gradient by the render:
//
//   loss = (1 - w) mean |x - y| + w (1 - mean SSIM(x, y))        (Kerbl et al. 2023, section 5.1)
//
// SSIM (Wang et al. 2004): 11-tap Gaussian window, sigma 1.5, zero padding, per channel.
// image: real[3, H, W], the render x; photo: uchar[3, H, W], y = photo / 255; partials: real[items,
// 2], sums of |x - y| and of SSIM, one row a work-item or group, added up in order by reduce.cl;
// MASKED: photo: uchar[4, H, W], whose last plane is 0 at pixels that do not count, else 255. They
// are treated as pixels beyond the border: both images are zero there, no window has its centre
// there, and their gradient is zero. They add 0 to the sum of |x - y| and 1 to that of SSIM, so
// that the means are over all pixels and a pixel has the same weight in every view.
// grad_image: real[3, H, W]. The gradient convolves three maps with the window, which is its own
// adjoint: per channel the gradients of SSIM by the window means of x, x^2 and x y.
//
// Item form: `image_loss` does both, and keeps the maps in the cache. Group form: `image_loss`
// writes partials and maps: real[3, 3, H, W]; `image_loss_adjoint` convolves these to grad_image.
#include "real.h"
#include "vector.h"

#define RADIUS 5
#define TAPS 11
#define C1 (0.01 * 0.01)
#define C2 (0.03 * 0.03)
// exp(-(k - 5)^2 / 4.5) normalised to sum 1
__constant real WINDOW[TAPS] = {
    0.001028380084479109, 0.007598758135239185, 0.03600077212843083, 0.10936068950970002,
    0.21300553771125370, 0.26601172486179436, 0.21300553771125370, 0.10936068950970002,
    0.03600077212843083, 0.007598758135239185, 0.001028380084479109};

// SSIM from the window means of x, y, x^2 + y^2 and x y, and its gradients by the means of x, x^2
// and x y.
#define MEANS 4
inline vreal ssim(vreal x, vreal y, vreal squares, vreal xy, vreal *by_x, vreal *by_xx,
                  vreal *by_xy)
{
    const vreal a1 = 2 * x * y + (real)C1, a2 = 2 * (xy - x * y) + (real)C2;
    const vreal b1 = x * x + y * y + (real)C1;
    const vreal b2 = squares - (x * x + y * y) + (real)C2;
    const vreal inverse = 1 / (b1 * b2); // the only division: 1 / b1 is b2 times this
    const vreal value = a1 * a2 * inverse;
    *by_x = 2 * inverse * (y * (a2 - a1) - x * value * (b2 - b1));
    *by_xx = -value * b1 * inverse;
    *by_xy = 2 * a1 * inverse;
    return value;
}

// Declares where the part number INDEX of the launch lies, an int, parts being WIDTH x HEIGHT
// pixels of a channel: `channel` and corner x0, y0.
#define LOCATE_PART(INDEX, WIDTH, HEIGHT)                                                          \
    const int across = (width + (WIDTH) - 1) / (WIDTH), down = (height + (HEIGHT) - 1) / (HEIGHT); \
    const int channel = (INDEX) / (across * down);                                                 \
    const int x0 = (INDEX) % across * (WIDTH), y0 = (INDEX) / across % down * (HEIGHT);            \
    const long plane = (long)width * height

#ifndef MASKED
#define MASKED 0
#endif
#if FORM_ITEM
#include "item/image_loss.cl"
#else
#include "group/image_loss.cl"
#endif
