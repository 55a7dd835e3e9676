#version 300 es
// A gaussian's splat as a square that holds its ellipse: cl/project.cl and cl/include/projection.h,
// which say why the determinant is computed as it is.
precision highp float;
precision highp int;
precision highp usampler2D;

#define SH_C0 0.28209479177387814
#define ALPHA_STEPS 255.0
#define LOW_PASS 0.3
#define AREA_RATIO_MIN 2.5e-5

uniform usampler2D places, shapes, rest, order;
uniform uint drawn; // of `order`, from back to front
uniform mat3 rotation; // columns: right, down, forward
uniform vec3 position;
uniform vec2 focal, centre, size;
uniform vec4 ratios; // lowest x/z and y/z of the Jacobian, and highest
uniform float near;
uniform vec3 log_scales[2], colours[2]; // the value of byte 0, and what byte 255 adds
uniform mat3 cut_axes; // columns: the axes of a box, outside of which nothing is drawn
uniform vec3 cut_low, cut_high; // its limits along them
uniform vec3 up, palette[5]; // of the lowest to the highest
uniform vec2 heights; // the lowest, and how much the highest is above it; 0: no colours of heights
uniform vec3 reaches; // of the harmonics of degree 1, 2 and 3: the value of byte 128 + 127

uint gaussian;
out vec2 across; // in standard deviations
flat out vec4 colour; // and opacity

ivec2 texel(uint index, usampler2D table) {
    uint width = uint(textureSize(table, 0).x);
    return ivec2(index % width, index / width);
}

vec3 bytes(uint word) {
    return vec3(word & 255u, word >> 8 & 255u, word >> 16 & 255u);
}

// Rows of the rotation of a quaternion: 10 bits for each but the largest component.
mat3 turned(uint word) {
    vec3 others = (vec3(word & 1023u, word >> 10 & 1023u, word >> 20 & 1023u) / 1023.0 - 0.5)
        * sqrt(2.0);
    float most = sqrt(max(0.0, 1.0 - dot(others, others)));
    uint which = word >> 30;
    vec4 q = which == 0u ? vec4(most, others) : which == 1u ? vec4(others.x, most, others.yz)
        : which == 2u ? vec4(others.xy, most, others.z) : vec4(others, most); // wxyz
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
                2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
                2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y));
}

#if DEGREE > 0
#define TEXELS (DEGREE > 2 ? 3 : DEGREE)
uvec4 words[TEXELS];

float stored(int k) {
    uint word = words[k >> 4][k >> 2 & 3];
    return (float(word >> (8 * (k & 3)) & 255u) - 128.0) / 127.0;
}

vec3 harmonic(int k) { return vec3(stored(3 * k), stored(3 * k + 1), stored(3 * k + 2)); }

// As cl/include/harmonics.h.
vec3 harmonics(vec3 d) {
    for (int k = 0; k < TEXELS; k++)
        words[k] = texelFetch(rest, texel(gaussian * uint(TEXELS) + uint(k), rest), 0);
    float x = d.x, y = d.y, z = d.z;
    vec3 sum = reaches.x * 0.4886025119029199 *
        (-y * harmonic(0) + z * harmonic(1) - x * harmonic(2));
#if DEGREE > 1
    float xx = x * x, yy = y * y, zz = z * z;
    sum += reaches.y * (1.0925484305920792 * (x * y * harmonic(3) - y * z * harmonic(4)
            - x * z * harmonic(6))
        + 0.31539156525252005 * (2.0 * zz - xx - yy) * harmonic(5)
        + 0.5462742152960396 * (xx - yy) * harmonic(7));
#endif
#if DEGREE > 2
    sum += reaches.z * (0.5900435899266435 * (-y * (3.0 * xx - yy) * harmonic(8)
            - x * (xx - 3.0 * yy) * harmonic(14))
        + 2.890611442640554 * x * y * z * harmonic(9)
        - 0.4570457994644658 * (4.0 * zz - xx - yy) * (y * harmonic(10) + x * harmonic(12))
        + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * harmonic(11)
        + 1.445305721320277 * z * (xx - yy) * harmonic(13));
#endif
    return sum;
}
#endif

void main() {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0); // outside, until it is known to be seen
    uint rank = uint(gl_InstanceID) * BUNDLE + uint(gl_VertexID >> 2);
    if (rank >= drawn)
        return;
    gaussian = texelFetch(order, texel(rank, order), 0).x;
    uvec4 place = texelFetch(places, texel(gaussian, places), 0);
    uvec2 shape = texelFetch(shapes, texel(gaussian, shapes), 0).xy;
    vec3 here = uintBitsToFloat(place.xyz), within = here * cut_axes, away = here - position;
    if (any(lessThan(within, cut_low)) || any(greaterThan(within, cut_high)))
        return;
    vec3 p = away * rotation;
    if (p.z <= near)
        return;
    vec2 ratio = clamp(p.xy / p.z, ratios.xy, ratios.zw), reach = focal / p.z;
    vec3 scale = exp(log_scales[0] + log_scales[1] * bytes(shape.x) / 255.0);
    mat3 turn = turned(shape.y); // column i is row i of the gaussian's rotation
    vec3 b1 = turn * (reach.x * (rotation[0] - ratio.x * rotation[2]));
    vec3 b2 = turn * (reach.y * (rotation[1] - ratio.y * rotation[2]));
    vec3 m1 = b1 * scale, m2 = b2 * scale;
    float m11 = dot(m1, m1), m22 = dot(m2, m2), xy = dot(m1, m2);
    vec3 sharp = cross(b1, b2) * scale.yzx * scale.zxy;
    float area = dot(sharp, sharp);
    float det = area + LOW_PASS * (m11 + m22) + LOW_PASS * LOW_PASS;
    float opacity = float(place.w >> 24) / 255.0;
#if ANTIALIASED
    opacity *= sqrt(max(area / det, AREA_RATIO_MIN));
#endif
    float cutoff = 2.0 * log(ALPHA_STEPS * opacity); // the squared distance where alpha is too faint
    if (!(cutoff > 0.0))
        return;
    // half axes of the ellipse: eigenvectors times roots of eigenvalues
    float mean = 0.5 * (m11 + m22) + LOW_PASS, half_difference = 0.5 * (m11 - m22);
    float root = length(vec2(half_difference, xy)), longer = mean + root, shorter = det / longer;
    vec2 axis = half_difference > 0.0 ? vec2(half_difference + root, xy)
        : vec2(xy, root - half_difference);
    axis = root > 1e-6 * mean ? normalize(axis) : vec2(1.0, 0.0);
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0;
    across = corner * sqrt(cutoff);
    vec2 offset = axis * sqrt(longer) * across.x
        + vec2(-axis.y, axis.x) * sqrt(max(shorter, 0.0)) * across.y;
    vec2 pixel = focal * p.xy / p.z + centre + offset;
    vec3 shade = colours[0] + colours[1] * bytes(place.w) / 255.0;
#if DEGREE > 0
    shade += harmonics(normalize(away));
#endif
    if (heights.y > 0.0) {
        float step = 4.0 * clamp((dot(here, up) - heights.x) / heights.y, 0.0, 1.0);
        shade = mix(palette[int(step)], palette[min(int(step) + 1, 4)], fract(step));
    }
    colour = vec4(max(shade, vec3(0.0)), opacity);
    gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}
