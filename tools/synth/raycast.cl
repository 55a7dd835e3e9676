// Photos of a made-up city by ray casting, and what a survey of it sees; raycast.py is the same in
// float64. Solids are found through a grid over x and y: a ray walks from cell to cell, and meets
// the solids of a cell's list where it is not above all of them. `primitive` is 0 for the ground,
// then counts the boxes, then the spheres.
#include "real.h"
#include "each.h"

#define CITY_ARGUMENTS                                                                             \
    uint box_count, int cells_x, int cells_y, int blocks_x, int blocks_y,                          \
        __global const real *restrict grid, __global const uint *restrict begins,                  \
        __global const uint *restrict members, __global const real *restrict tops,                 \
        __global const real *restrict boxes, __global const real *restrict spheres,                \
        __global const uint *restrict kinds, __global const real *restrict paint,                  \
        __global const uchar *restrict parks, __global const real *restrict lattice
#define CITY                                                                                       \
    {                                                                                              \
        box_count, cells_x, cells_y, blocks_x, blocks_y, (real2)(grid[0], grid[1]), grid[2],       \
            grid[3], begins, members, tops, boxes, spheres, kinds, paint, parks, lattice           \
    }
typedef struct {
    uint box_count;
    int cells_x, cells_y, blocks_x, blocks_y;
    real2 low;                    // corner of the grid
    real cell, top;               // width of a cell; the height of the highest solid
    __global const uint *begins;  // [cells + 1] of the list of a cell in
    __global const uint *members; // primitives
    __global const real *tops;    // [cells] the height of the highest solid of a cell
    __global const real *boxes;   // [B, 6] low and high corners
    __global const real *spheres; // [S, 4] centre and radius
    __global const uint *kinds;   // [B]
    __global const real *paint;   // [B, PAINT_REALS]
    __global const uchar *parks;  // [blocks x, blocks y]
    __global const real *lattice; // [LATTICE, LATTICE, LATTICE]
} City;

#include "texture.h"

#define NO_HIT ((real)INFINITY)
#define SUN ((real3)(SUN_X, SUN_Y, SUN_Z))

// A camera of SURVEY_REALS numbers: position, rotation, focal length, centre, gains.
inline real3 from_camera(__global const real *camera, real3 v)
{
    return v.x * row3(camera, 3) + v.y * row3(camera, 6) + v.z * row3(camera, 9);
}

// The ray parameter at which a ray enters a primitive that is not the ground.
INLINE real meets(const City *city, uint primitive, real3 origin, real3 direction, real3 inverse)
{
    if (primitive <= city->box_count) {
        const ulong row = (ulong)(primitive - 1) * 6;
        const real3 first = (row3(city->boxes, row) - origin) * inverse;
        const real3 second = (row3(city->boxes, row + 3) - origin) * inverse;
        const real3 low = fmin(first, second), high = fmax(first, second);
        const real enter = fmax(fmax(low.x, low.y), low.z);
        return enter <= fmin(fmin(high.x, high.y), high.z) && enter > 0 ? enter : NO_HIT;
    }
    const ulong row = (ulong)(primitive - 1 - city->box_count) * 4;
    const real radius = city->spheres[row + 3];
    const real3 offset = origin - row3(city->spheres, row);
    // from the point of the ray nearest to the centre, since far away float32 loses digits
    const real a = dot(direction, direction), b = dot(offset, direction);
    const real3 miss = offset - b / a * direction;
    const real root = a * (radius * radius - dot(miss, miss));
    const real enter = (-b - sqrt(fmax(root, (real)0))) / a;
    return root > 0 && enter > 0 ? enter : NO_HIT;
}

// The nearest solid that a ray meets before the parameter *nearest, which becomes its own, or any
// if that is enough; 0 if there is none. The ray starts on the primitive `own`, which is convex.
INLINE uint solid_on(const City *city, real3 origin, real3 direction, uint own, bool is_any,
                     real *nearest)
{
    const real3 inverse = 1 / (real3)(direction.x == 0 ? (real)1e-12 : direction.x,
                                      direction.y == 0 ? (real)1e-12 : direction.y,
                                      direction.z == 0 ? (real)1e-12 : direction.z);
    // the part of the ray over the grid and not above all solids
    const real2 near = (city->low - origin.xy) * inverse.xy;
    const real2 size = (real2)(city->cells_x, city->cells_y) * city->cell;
    const real2 far = (city->low + size - origin.xy) * inverse.xy;
    const real2 enters = fmin(near, far), leaves = fmax(near, far);
    const real at_top = (city->top - origin.z) * inverse.z;
    real begin = fmax(fmax(enters.x, enters.y), (real)0);
    real end = fmin(leaves.x, leaves.y);
    if (direction.z < 0)
        begin = fmax(begin, at_top);
    else
        end = fmin(end, at_top);
    if (begin >= fmin(end, *nearest))
        return 0;

    const real2 start = (origin.xy + begin * direction.xy - city->low) / city->cell;
    int x = clamp((int)floor(start.x), 0, city->cells_x - 1);
    int y = clamp((int)floor(start.y), 0, city->cells_y - 1);
    const int ahead_x = inverse.x > 0, ahead_y = inverse.y > 0;
    uint found = 0;
    while (x >= 0 && x < city->cells_x && y >= 0 && y < city->cells_y) {
        const real leave_x = (city->low.x + (x + ahead_x) * city->cell - origin.x) * inverse.x;
        const real leave_y = (city->low.y + (y + ahead_y) * city->cell - origin.y) * inverse.y;
        const real leave = fmin(fmin(leave_x, leave_y), end);
        const int cell = y * city->cells_x + x;
        if (origin.z + direction.z * (direction.z < 0 ? leave : begin) <= city->tops[cell])
            for (uint i = city->begins[cell]; i < city->begins[cell + 1]; i++) {
                const uint solid = city->members[i];
                const real met = meets(city, solid, origin, direction, inverse);
                if (solid != own && (met < *nearest || (met == *nearest && solid < found))) {
                    *nearest = met, found = solid;
                    if (is_any)
                        return found;
                }
            }
        if (leave >= fmin(end, *nearest))
            break;
        begin = leave;
        if (leave_x < leave_y)
            x += 2 * ahead_x - 1;
        else
            y += 2 * ahead_y - 1;
    }
    return found;
}

// The outward normal at a point of a primitive's surface; a box's point is put into its face.
INLINE real3 normal_at(const City *city, uint primitive, real3 *point)
{
    if (primitive == 0)
        return (real3)(0, 0, 1);
    if (primitive > city->box_count) {
        const ulong row = (ulong)(primitive - 1 - city->box_count) * 4;
        return (*point - row3(city->spheres, row)) / city->spheres[row + 3];
    }
    const real3 low = row3(city->boxes, (ulong)(primitive - 1) * 6);
    const real3 high = row3(city->boxes, (ulong)(primitive - 1) * 6 + 3);
    const real3 offset = *point - (low + high) / 2;
    const real3 off = fabs(fabs(offset) - (high - low) / 2);
    if (off.x <= off.y && off.x <= off.z) {
        point->x = offset.x > 0 ? high.x : low.x;
        return (real3)(offset.x > 0 ? 1 : -1, 0, 0);
    }
    if (off.y <= off.z) {
        point->y = offset.y > 0 ? high.y : low.y;
        return (real3)(0, offset.y > 0 ? 1 : -1, 0);
    }
    point->z = offset.z > 0 ? high.z : low.z;
    return (real3)(0, 0, offset.z > 0 ? 1 : -1);
}

// The colour of a surface point under the light of sun and sky.
INLINE real3 shade(const City *city, uint primitive, real3 point)
{
    const real3 normal = normal_at(city, primitive, &point);
    real sun = fmax(dot(normal, SUN), (real)0), far = NO_HIT;
    if (sun > 0 && solid_on(city, point + (real)1e-4 * normal, SUN, primitive, true, &far))
        sun = 0;
    const real height = clamp(point.z / 3 + (primitive == 0), (real)0, (real)1);
    const real sky = ((real)0.75 + (real)0.25 * normal.z) * ((real)0.75 + (real)0.25 * height);
    const real3 light = sun * (real3)(SUNLIGHT_R, SUNLIGHT_G, SUNLIGHT_B) +
                        sky * (real3)(SKYLIGHT_R, SKYLIGHT_G, SKYLIGHT_B);
    return clamp(albedo(city, primitive, point, normal) * light, (real)0, (real)1);
}

inline uchar3 displayed(real3 light)
{
    const real power = 1 / (real)DISPLAY_GAMMA;
    const real3 shown = pow(clamp(light, (real)0, (real)1), (real3)(power, power, power));
    return convert_uchar3_sat(rint(255 * shown));
}

// image[row, column, :]: a photo, each pixel of which is the mean of a square of rays.
__kernel void draw(uint width, uint height, CITY_ARGUMENTS, __global const real *restrict camera,
                   __global uchar *restrict image)
{
    const City city = CITY;
    FOR_EACH(i, (ulong)width * height)
    {
        const real3 origin = row3(camera, 0);
        real3 sum = 0;
        for (int sample = 0; sample < SAMPLES_PER_SIDE * SAMPLES_PER_SIDE; sample++) {
            const real column =
                i % width + (sample % SAMPLES_PER_SIDE + (real)0.5) / SAMPLES_PER_SIDE;
            const real row = i / width + (sample / SAMPLES_PER_SIDE + (real)0.5) / SAMPLES_PER_SIDE;
            const real3 direction =
                from_camera(camera, (real3)((column - camera[14]) / camera[12],
                                            (row - camera[15]) / camera[13], 1));
            real met = direction.z < 0 ? -origin.z / direction.z : NO_HIT;
            const bool is_sky = met == NO_HIT;
            const uint primitive = solid_on(&city, origin, direction, 0, false, &met);
            real3 point = origin + met * direction;
            if (primitive == 0)
                point.z = 0;
            sum += primitive || !is_sky ? shade(&city, primitive, point)
                                        : (real3)(SKY_R, SKY_G, SKY_B);
        }
        const real3 light = sum / (SAMPLES_PER_SIDE * SAMPLES_PER_SIDE);
        vstore3(displayed(light * row3(camera, 16)), i, image);
    }
}

// The standard deviation of the lightness of a surface about a point, on two rings.
INLINE real contrast_at(const City *city, uint primitive, real3 point, real3 normal)
{
    const real3 side = fabs(normal.z) > (real)0.7 ? (real3)(1, 0, 0) : (real3)(0, 0, 1);
    const real3 right = normalize(cross(normal, side)), up = cross(normal, right);
    real sum = 0, squares = 0;
    for (int k = 0; k < 8; k++) {
        const real angle = k * (real)(M_PI_F / 4), away = (k & 1 ? 2 : 4) * (real)PIXEL;
        const real3 there = point + away * (cos(angle) * right + sin(angle) * up);
        const real light = dot(albedo(city, primitive, there, normal), (real3)(0.3, 0.6, 0.1));
        sum += light, squares += light * light;
    }
    return sqrt(fmax(squares / 8 - sum * sum / 64, (real)0));
}

// For each candidate, a point of a surface: its colour, the number of views that observe it and, in
// slots, up to MOST_OBSERVATIONS of these. A detector finds points of high contrast, seldom those
// on plain surfaces, and none where a noise field leaves gaps; and it misses a point in some views,
// the more so the flatter the view.
__kernel void observe(uint count, uint view_count, uint first, int seed, CITY_ARGUMENTS,
                      __global const real *restrict points,
                      __global const uint *restrict primitives,
                      __global const real *restrict cameras, real width, real height, real border,
                      __global uint *restrict found, __global uint *restrict slots,
                      __global uchar *restrict colours)
{
    const City city = CITY;
    FOR_EACH(i, count)
    {
        found[i] = 0;
        const uint primitive = primitives[i];
        const int number = first + (uint)i;
        real3 point = row3(points, i * 3);
        const real3 normal = normal_at(&city, primitive, &point);
        const real patch = noise(city.lattice, point + 120, PATCH_WIDTH) - (real)PATCH_GAPS;
        const real contrast = contrast_at(&city, primitive, point, normal);
        const real chance = fmin((contrast - (real)CONTRAST_LOW) / (real)CONTRAST_RANGE, (real)1) *
                            clamp(patch * 10, (real)0, (real)1);
        if (hash(number, seed, -1) >= chance)
            continue;
        uint seen = 0;
        for (uint view = 0; view < view_count; view++) {
            if (hash(number, seed, (int)view) >= (real)DETECTION_RATE)
                continue;
            __global const real *camera = cameras + (ulong)view * SURVEY_REALS;
            const real3 ray = point - row3(camera, 0);
            const real depth = dot(ray, row3(camera, 9));
            const real x = dot(ray, row3(camera, 3)) / depth * camera[12] + camera[14];
            const real y = dot(ray, row3(camera, 6)) / depth * camera[13] + camera[15];
            if (!(depth > 0 && x > border && y > border && x < width - border &&
                  y < height - border))
                continue;
            const real cosine = -dot(ray, normal) / length(ray);
            if (hash((int)view, number, seed) >= 2 * cosine) // never from behind
                continue;
            real met = 1 - (real)1e-3 / length(ray);
            if (solid_on(&city, row3(camera, 0), ray, primitive, true, &met))
                continue;
            // of too many, each stays with the same chance
            const uint slot = seen < MOST_OBSERVATIONS
                                  ? seen
                                  : (uint)(hash(seed, number, (int)view) * (seen + 1));
            if (slot < MOST_OBSERVATIONS)
                slots[i * MOST_OBSERVATIONS + slot] = view;
            seen++;
        }
        found[i] = min(seen, (uint)MOST_OBSERVATIONS);
        if (found[i] > 1)
            vstore3(displayed(shade(&city, primitive, point)), i, colours);
    }
}
