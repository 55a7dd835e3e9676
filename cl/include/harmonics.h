// Real spherical harmonics to degree 3 in the order and sign of 3DGS (Ramamoorthi & Hanrahan 2001;
// Kerbl et al. 2023). Band 0 is handled by the caller; entry k here is harmonic k + 1. The active
// degree is a constant of the build, so that arrays of harmonics live in registers.
#ifndef SH_REST
#error "SH_REST, the stored harmonics above the constant (0, 3, 8 or 15), must be defined"
#endif
#ifndef DEGREE
#error "DEGREE, the active degree (0 to 3, within SH_REST), must be defined"
#endif
#define SH_ACTIVE (DEGREE * (DEGREE + 2)) // harmonics above the constant that are active
#define SH_SIZE (SH_ACTIVE > 0 ? SH_ACTIVE : 1)
#define SH_C1 ((real)0.4886025119029199)
#define SH_C2A ((real)1.0925484305920792)
#define SH_C2B ((real)0.31539156525252005)
#define SH_C2C ((real)0.5462742152960396)
#define SH_C3A ((real)0.5900435899266435)
#define SH_C3B ((real)2.890611442640554)
#define SH_C3C ((real)0.4570457994644658)
#define SH_C3D ((real)0.3731763325901154)
#define SH_C3E ((real)1.445305721320277)

inline void harmonics(real3 d, real *basis)
{
    const real x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
#if DEGREE >= 1
    basis[0] = -SH_C1 * y;
    basis[1] = SH_C1 * z;
    basis[2] = -SH_C1 * x;
#endif
#if DEGREE >= 2
    basis[3] = SH_C2A * x * y;
    basis[4] = -SH_C2A * y * z;
    basis[5] = SH_C2B * (2 * zz - xx - yy);
    basis[6] = -SH_C2A * x * z;
    basis[7] = SH_C2C * (xx - yy);
#endif
#if DEGREE >= 3
    basis[8] = -SH_C3A * y * (3 * xx - yy);
    basis[9] = SH_C3B * x * y * z;
    basis[10] = -SH_C3C * y * (4 * zz - xx - yy);
    basis[11] = SH_C3D * z * (2 * zz - 3 * xx - 3 * yy);
    basis[12] = -SH_C3C * x * (4 * zz - xx - yy);
    basis[13] = SH_C3E * z * (xx - yy);
    basis[14] = -SH_C3A * x * (xx - 3 * yy);
#endif
}

// Gradients of a colour by direction, along x, y and z, each of three channels; h: the coefficients
// of its harmonics.
inline void harmonics_slopes(real3 d, const real3 *h, real3 *slope_x, real3 *slope_y,
                             real3 *slope_z)
{
    const real x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    real3 gx = (real3)(0), gy = gx, gz = gx;
#if DEGREE >= 1
    gx -= SH_C1 * h[2];
    gy -= SH_C1 * h[0];
    gz += SH_C1 * h[1];
#endif
#if DEGREE >= 2
    gx += SH_C2A * (y * h[3] - z * h[6]) + 2 * x * (SH_C2C * h[7] - SH_C2B * h[5]);
    gy += SH_C2A * (x * h[3] - z * h[4]) - 2 * y * (SH_C2C * h[7] + SH_C2B * h[5]);
    gz += 4 * SH_C2B * z * h[5] - SH_C2A * (y * h[4] + x * h[6]);
#endif
#if DEGREE >= 3
    gx += -6 * SH_C3A * x * y * h[8] + SH_C3B * y * z * h[9] + 2 * SH_C3C * x * y * h[10];
    gx += -6 * SH_C3D * x * z * h[11] - SH_C3C * (4 * zz - 3 * xx - yy) * h[12];
    gx += 2 * SH_C3E * x * z * h[13] - 3 * SH_C3A * (xx - yy) * h[14];
    gy += -3 * SH_C3A * (xx - yy) * h[8] + SH_C3B * x * z * h[9];
    gy += -SH_C3C * (4 * zz - xx - 3 * yy) * h[10] - 6 * SH_C3D * y * z * h[11];
    gy += 2 * SH_C3C * x * y * h[12] - 2 * SH_C3E * y * z * h[13] + 6 * SH_C3A * x * y * h[14];
    gz += SH_C3B * x * y * h[9] - 8 * SH_C3C * y * z * h[10];
    gz += SH_C3D * (6 * zz - 3 * (xx + yy)) * h[11] - 8 * SH_C3C * x * z * h[12];
    gz += SH_C3E * (xx - yy) * h[13];
#endif
    *slope_x = gx;
    *slope_y = gy;
    *slope_z = gz;
}
