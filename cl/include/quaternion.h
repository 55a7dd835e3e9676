// Rotations from quaternions (w, x, y, z) of any length, and the adjoint.

// Unit quaternion; *length gets the length: 0 for a quaternion without direction, which is culled.
inline real4 unit_quaternion(real4 q, real *length_out)
{
    const real largest = max(max(fabs(q.x), fabs(q.y)), max(fabs(q.z), fabs(q.w)));
    *length_out = 0;
    if (!(largest > 0) || !isfinite(largest))
        return (real4)(1, 0, 0, 0);
    const real4 scaled = q / largest; // so that squares neither overflow nor vanish
    const real norm = sqrt(dot(scaled, scaled));
    *length_out = norm * largest;
    return scaled / norm;
}

// Rows of the rotation matrix of a unit quaternion; .x is w, .y is x, .z is y, .w is z.
inline void rotation_rows(real4 q, real3 *row0, real3 *row1, real3 *row2)
{
    const real w = q.x, x = q.y, y = q.z, z = q.w;
    *row0 = (real3)(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y));
    *row1 = (real3)(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x));
    *row2 = (real3)(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y));
}

// Gradient of the raw quaternion from that by a small turn, a vector in the gaussian's own axes:
// d unit = 1/2 unit (0, turn), a product of quaternions.
inline real4 turn_adjoint(real4 unit, real length, real3 grad_turn)
{
    const real3 v = unit.yzw;
    return 2 / length * (real4)(-dot(v, grad_turn), unit.x * grad_turn + cross(v, grad_turn));
}
