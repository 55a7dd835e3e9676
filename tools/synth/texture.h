// Colours of the city's surfaces as functions of the surface point; texture.py explains them.

#define MIX(FIRST, SECOND, WEIGHT) ((FIRST) + ((SECOND) - (FIRST)) * (WEIGHT))
// columns of a row of `paint`
#define PAINT_FACADE 0
#define PAINT_ROOF 3
#define PAINT_CAR 6
#define PAINT_PART 9
#define PAINT_BAY 12
#define PAINT_STOREY 13
#define PAINT_SHARE 14

inline real3 row3(__global const real *rows, ulong first)
{
    return (real3)(rows[first], rows[first + 1], rows[first + 2]);
}

inline real below(real value, real edge)
{
    return clamp((edge - value) / EDGE + (real)0.5, (real)0, (real)1);
}

inline real fraction(real value)
{
    return value - floor(value);
}

inline real stripes(real value, real period, real share)
{
    return below(fabs(fraction(value / period) - (real)0.5) * period, share * period / 2);
}

// A number from 0 to 1 for each triple of whole numbers.
inline real hash(int x, int y, int z)
{
    uint value = (uint)x * 0x8DA6B343u ^ (uint)y * 0xD8163841u ^ (uint)z * 0xCB1AB31Fu;
    value = (value ^ value >> 15) * 0x2C1B3C6Du;
    value = (value ^ value >> 12) * 0x297A2D39u;
    value = value ^ value >> 15;
    return (real)(value >> 8) / 16777216;
}

inline real corner(__global const real *lattice, int x, int y, int z)
{
#if OCTAVES
    return hash(x, y, z);
#else
    x &= LATTICE - 1, y &= LATTICE - 1, z &= LATTICE - 1; // a power of two
    return lattice[(x * LATTICE + y) * LATTICE + z];
#endif
}

inline real noise(__global const real *lattice, real3 point, real scale)
{
    const real3 cell = point / scale, low = floor(cell), part = cell - low;
    const real3 fade = part * part * (3 - 2 * part);
    const int x = (int)low.x, y = (int)low.y, z = (int)low.z;
    real value = 0;
    for (int k = 0; k < 8; k++) {
        const int i = k >> 2, j = k >> 1 & 1, l = k & 1;
        value += (i ? fade.x : 1 - fade.x) * (j ? fade.y : 1 - fade.y) *
                 (l ? fade.z : 1 - fade.z) * corner(lattice, x + i, y + j, z + l);
    }
    return value;
}

inline real grain(__global const real *lattice, real3 point)
{
    real total = 0;
#if OCTAVES
    real scale = COARSEST_GRAIN;
    for (int octave = 0; octave < OCTAVES; octave++, scale /= 2)
        total += noise(lattice, point + (real)17.3 * octave, scale) - (real)0.5;
    total /= sqrt((real)OCTAVES);
#endif
    return total;
}

inline real to_street(real coordinate, int count)
{
    const real half_count = count / (real)2;
    const real line = clamp(rint(coordinate / BLOCK_WIDTH + half_count), (real)0, (real)count);
    return coordinate - (line - half_count) * BLOCK_WIDTH;
}

// The marks of the street along which `along` runs, at distance `across` from its middle.
inline real markings(real across, real along, real line)
{
    const real is_free = 1 - below(fabs(along), STREET + (real)2.2);
    const real dashes = below(fabs(across), 0.12) * stripes(line, 2.0, 0.55) * is_free;
    const real zebra = below(fabs(fabs(along) - STREET - (real)0.9), 0.6) *
                       stripes(across, 0.8, 0.5) * below(fabs(across), STREET - (real)0.2);
    return fmax(dashes, zebra);
}

INLINE real3 ground_colour(const City *city, real3 point)
{
    const real x = point.x, y = point.y;
    const real reach_x = city->blocks_x * BLOCK_WIDTH / 2;
    const real reach_y = city->blocks_y * BLOCK_WIDTH / 2;
    const real coarse = noise(city->lattice, point, 7.0), middle = noise(city->lattice, point, 1.7);
    const real fine = noise(city->lattice, point, 0.5), grains = grain(city->lattice, point);
    const real u = to_street(x, city->blocks_x), v = to_street(y, city->blocks_y);
    const real built = fmax(fabs(x) - reach_x, fabs(y) - reach_y);
    const real near = fmin(fabs(u), fabs(v));

    real3 lawn = MIX((real3)(0.36, 0.45, 0.22), (real3)(0.55, 0.52, 0.30), coarse);
    lawn *= (real)0.8 + (real)0.25 * middle + (real)0.15 * fine + (real)0.9 * grains;
    real3 yard = (real3)(0.60, 0.57, 0.52) * ((real)0.82 + (real)0.18 * middle + (real)0.12 * fine);
    yard *= 1 - (real)0.15 * fmax(stripes(x, 1.5, 0.1), stripes(y, 1.5, 0.1));
    real3 pavement = (real3)(0.66, 0.65, 0.63) * ((real)0.88 + (real)0.2 * middle);
    real3 asphalt =
        (real3)(0.33, 0.34, 0.36) * ((real)0.8 + (real)0.2 * middle + (real)0.2 * fine);
#if OCTAVES
    const real slab = hash((int)floor(x / (real)0.5), (int)floor(y / (real)0.5), 0);
    const real joints = fmax(stripes(x, 0.5, 0.07), stripes(y, 0.5, 0.07));
    yard *= ((real)0.88 + (real)0.24 * slab + (real)0.35 * grains) * (1 - (real)0.35 * joints);
    yard = MIX(yard, lawn, below(0.56, noise(city->lattice, point + 20, 4.0)));
    pavement *= ((real)0.9 + (real)0.2 * slab + (real)0.3 * grains) * (1 - (real)0.3 * joints);
    pavement = MIX(pavement, (real3)(0.80, 0.79, 0.76), below(fabs(near - STREET), 0.12));
    const real mended = below(0.68, noise(city->lattice, point + 40, 1.3));
    const real off = fabs(noise(city->lattice, point + 80, 0.9) - (real)0.5);
    const real crack = below(off * (real)0.9, 0.012);
    asphalt *= (1 + (real)0.7 * grains) * (1 - (real)0.3 * mended) * (1 - (real)0.3 * crack);
#endif
    const real place_x = x / BLOCK_WIDTH + city->blocks_x / (real)2;
    const real place_y = y / BLOCK_WIDTH + city->blocks_y / (real)2;
    const int block_x = clamp((int)floor(place_x), 0, city->blocks_x - 1);
    const int block_y = clamp((int)floor(place_y), 0, city->blocks_y - 1);
    const real from_middle = hypot((place_x - block_x - (real)0.5) * BLOCK_WIDTH,
                                   (place_y - block_y - (real)0.5) * BLOCK_WIDTH);
    const real path =
        below(fabs(from_middle - (real)0.55 * (BLOCK_WIDTH / 2 - STREET - PAVEMENT)), 0.6);
    const real3 park = MIX(lawn, (real3)(0.72, 0.65, 0.50), path);
    const real3 inside = city->parks[block_x * city->blocks_y + block_y] ? park : yard;
    real3 colour = MIX(lawn, inside, below(built, 0));

    colour = MIX(colour, pavement,
                 below(near, STREET + PAVEMENT) * below(built, STREET + PAVEMENT));
    const real road = below(near, STREET) * below(built, STREET);
    colour = MIX(colour, asphalt, road);
    const real3 white = (real3)(0.85, 0.84, 0.80);
    colour = MIX(colour, white, markings(u, v, y) * road * (real)0.9);
    return MIX(colour, white, markings(v, u, x) * road * (real)0.9);
}

INLINE real3 roof_colour(const City *city, uint box, real3 point, real edge)
{
    const real stain = noise(city->lattice, point, 2.3), rough = noise(city->lattice, point, 0.45);
    real3 roof = row3(city->paint, (ulong)box * PAINT_REALS + PAINT_ROOF) *
                 ((real)0.72 + (real)0.35 * stain + (real)0.15 * rough);
#if OCTAVES
    const real tile =
        hash((int)floor(point.x / (real)0.34), (int)floor(point.y / (real)0.26), (int)box);
    const real seam = fmax(stripes(point.x, 0.34, 0.1), stripes(point.y, 0.26, 0.12));
    const real moss = below(0.66, noise(city->lattice, point + 60, 0.8));
    roof *= ((real)0.84 + (real)0.32 * tile + (real)0.7 * grain(city->lattice, point)) *
            (1 - (real)0.35 * seam);
    roof = MIX(roof, (real3)(0.33, 0.34, 0.28), (real)0.6 * moss);
#endif
    return MIX(roof, (real3)(0.80, 0.79, 0.76), below(edge, 0.3));
}

INLINE real3 facade_colour(const City *city, uint box, real3 point, real3 normal, real3 low,
                           real3 high)
{
    __global const real *paint = city->paint + (ulong)box * PAINT_REALS;
    const real stain = noise(city->lattice, point, 2.3), rough = noise(city->lattice, point, 0.45);
    const int along = fabs(normal.x) > (real)0.5;
    const real width = along ? high.y - low.y : high.x - low.x;
    const real bay = width / fmax(rint(width / paint[PAINT_BAY]), (real)1);
    const real storey = high.z / fmax(rint(high.z / paint[PAINT_STOREY]), (real)1);
    const real column = (along ? point.y - low.y : point.x - low.x) / bay;
    const real level = point.z / storey;
    const real off_x = fabs(fraction(column) - (real)0.5) * bay;
    const real off_z = fabs(fraction(level) - (real)0.5) * storey;
    const real half_x = paint[PAINT_SHARE] * bay / 2, half_z = paint[PAINT_SHARE + 1] * storey / 2;
    const real pane = fmin(below(off_x, half_x), below(off_z, half_z));
    const int face = (int)box * 4 + along * 2 + (normal.x + normal.y + normal.z > 0) + 5;
    const int lit_x = (int)floor(column) & (LATTICE - 1), lit_y = (int)floor(level) & (LATTICE - 1);
    const real lit =
        city->lattice[(lit_x * LATTICE + lit_y) * LATTICE + (face & (LATTICE - 1))];
    real3 glass = (real3)(0.20, 0.25, 0.31) +
                  fmax(lit - (real)0.6, (real)0) * (real3)(0.9, 0.8, 0.6);
    const real3 plain = row3(paint, PAINT_FACADE);
    real3 wall = plain * ((real)0.85 + (real)0.2 * stain + (real)0.1 * rough);
    wall = MIX(wall, plain * (real)0.65, below(point.z, 0.25));
    wall = MIX(wall, plain * (real)1.15, below(high.z - point.z, 0.2));
#if OCTAVES
    const real course = stripes(point.z, 0.25, 0.12);
    wall *= (1 + (real)0.3 * grain(city->lattice, point)) * (1 - (real)0.12 * course);
    const real frame =
        fmin(below(off_x, half_x + (real)0.07), below(off_z, half_z + (real)0.07));
    wall = MIX(wall, (real3)(0.86, 0.85, 0.82), frame);
    glass = MIX(glass, (real3)(0.80, 0.79, 0.76), below(off_x, 0.025));
#endif
    return wall * (1 - pane) + glass * pane;
}

INLINE real3 leaf_colour(const City *city, real3 point)
{
    const real tone = noise(city->lattice, point, 5.0), clump = noise(city->lattice, point, 0.9);
    const real leaf = noise(city->lattice, point, 0.4);
    const real3 green = MIX((real3)(0.18, 0.34, 0.12), (real3)(0.48, 0.50, 0.18), tone);
    return green * fmax((real)0.45 + (real)0.55 * clump + (real)0.4 * leaf +
                            (real)1.6 * grain(city->lattice, point), (real)0.2);
}

// The colour of a point of a primitive: 0 for the ground, then boxes, then spheres.
INLINE real3 albedo(const City *city, uint primitive, real3 point, real3 normal)
{
    if (primitive == 0)
        return clamp(ground_colour(city, point), (real)0, (real)1);
    if (primitive > city->box_count)
        return clamp(leaf_colour(city, point), (real)0, (real)1);
    const uint box = primitive - 1;
    const real3 low = row3(city->boxes, (ulong)box * 6);
    const real3 high = row3(city->boxes, (ulong)box * 6 + 3);
    const real edge = fmin(fmin(point.x - low.x, high.x - point.x),
                           fmin(point.y - low.y, high.y - point.y));
    const bool is_top = normal.z > (real)0.5;
    __global const real *paint = city->paint + (ulong)box * PAINT_REALS;
    real3 colour;
    switch (city->kinds[box]) {
    case KIND_BUILDING:
        colour = is_top ? roof_colour(city, box, point, edge)
                        : facade_colour(city, box, point, normal, low, high);
        break;
    case KIND_PLANT:
        colour = (real3)(0.72, 0.73, 0.74) *
                 ((real)0.8 + (real)0.25 * noise(city->lattice, point, 0.6));
        colour = MIX(colour, (real3)(0.35, 0.36, 0.38),
                     is_top ? (real)0 : (real)0.7 * stripes(point.z, 0.5, 0.4));
        break;
    case KIND_CAR:
        colour = MIX(row3(paint, PAINT_CAR), (real3)(0.10, 0.10, 0.11), below(point.z, 0.14));
        break;
    case KIND_CABIN: // of the car before it
        colour = is_top ? row3(paint - PAINT_REALS, PAINT_CAR) * (real)0.95
                        : (real3)(0.16, 0.19, 0.23);
        break;
    case KIND_TRUNK:
        colour = (real3)(0.36, 0.27, 0.20) *
                 ((real)0.8 + (real)0.4 * noise(city->lattice, point, 0.4));
        break;
    default: // KIND_PART
        colour = row3(paint, PAINT_PART) * (1 + (real)0.4 * grain(city->lattice, point));
        colour = MIX(colour, (real3)(0.62, 0.62, 0.60), is_top ? below(edge, 0.03) : (real)0);
    }
    return clamp(colour, (real)0, (real)1);
}
