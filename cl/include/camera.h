// The camera as a row of reals; packed by clsplat/rendering/project.py in this order.
// Axes right, down, forward; the centre of pixel (0, 0) is at (0.5, 0.5).
// ORTHOGRAPHIC: all rays are parallel to the camera's axis, as in a map. CAMERA_FOCAL is then in
// pixels a world unit, whatever the depth, and CAMERA_POSITION is not used. Forward only: it has no
// adjoint.
#ifndef ORTHOGRAPHIC
#define ORTHOGRAPHIC 0
#endif
enum {
    CAMERA_ROTATION = 0, // 9, world to camera, row-major
    CAMERA_TRANSLATION = 9,
    CAMERA_FOCAL = 12,
    CAMERA_CENTRE = 14,
    CAMERA_POSITION = 16, // world
    CAMERA_NEAR = 19,
    CAMERA_LOW_PASS = 20, // pixels squared, added to the footprint's variances
    CAMERA_SIZE = 21, // width, height
    CAMERA_RATIOS = 23 // lowest x/z and y/z for the Jacobian, and highest
};
typedef char the_camera_is_whole[CAMERA_RATIOS + 4 == CAMERA_REALS ? 1 : -1];

inline real3 to_camera(__global const real *camera, real3 world)
{
    __global const real *r = camera + CAMERA_ROTATION;
    return (real3)(dot(vload3(0, r), world), dot(vload3(1, r), world), dot(vload3(2, r), world)) +
           vload3(0, camera + CAMERA_TRANSLATION);
}

// Rotate a camera-frame gradient back to the world frame.
inline real3 to_world(__global const real *camera, real3 v)
{
    __global const real *r = camera + CAMERA_ROTATION;
    return v.x * vload3(0, r) + v.y * vload3(1, r) + v.z * vload3(2, r);
}

// What a pinhole camera divides sizes by.
inline real divisor_of(real3 p)
{
    return ORTHOGRAPHIC ? (real)1 : p.z;
}

// x/z and y/z for the Jacobian, held within 15 % of the photo beyond its borders: the linearised
// perspective is meaningless far outside (Zwicker et al. 2002; Kerbl et al. 2023).
inline real2 clamped_ratio(__global const real *camera, real3 p)
{
    if (ORTHOGRAPHIC)
        return (real2)(0);
    return clamp(p.xy / p.z, vload2(0, camera + CAMERA_RATIOS), vload2(1, camera + CAMERA_RATIOS));
}

// Unit vector from the camera to a point, world: the direction in which harmonics are seen.
inline real3 view_direction(__global const real *camera, real3 world)
{
    if (ORTHOGRAPHIC)
        return vload3(2, camera + CAMERA_ROTATION);
    const real3 offset = world - vload3(0, camera + CAMERA_POSITION);
    return offset * (1 / length(offset));
}
