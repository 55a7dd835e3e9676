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

// Gradient by direction of sum_k weight[k] * basis[k](d).
inline real3 harmonics_gradient(real3 d, const real *weight)
{
    const real x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
    real3 g = (real3)(0);
#if DEGREE >= 1
    g += SH_C1 * (real3)(-weight[2], -weight[0], weight[1]);
#endif
#if DEGREE >= 2
    g += SH_C2A * weight[3] * (real3)(y, x, 0) - SH_C2A * weight[4] * (real3)(0, z, y);
    g += 2 * SH_C2B * weight[5] * (real3)(-x, -y, 2 * z);
    g += 2 * SH_C2C * weight[7] * (real3)(x, -y, 0) - SH_C2A * weight[6] * (real3)(z, 0, x);
#endif
#if DEGREE >= 3
    g -= SH_C3A * weight[8] * (real3)(6 * x * y, 3 * (xx - yy), 0);
    g += SH_C3B * weight[9] * (real3)(y * z, x * z, x * y);
    g -= SH_C3C * weight[10] * (real3)(-2 * x * y, 4 * zz - xx - 3 * yy, 8 * y * z);
    g += SH_C3D * weight[11] * (real3)(-6 * x * z, -6 * y * z, 6 * zz - 3 * (xx + yy));
    g -= SH_C3C * weight[12] * (real3)(4 * zz - 3 * xx - yy, -2 * x * y, 8 * x * z);
    g += SH_C3E * weight[13] * (real3)(2 * x * z, -2 * y * z, xx - yy);
    g -= SH_C3A * weight[14] * (real3)(3 * (xx - yy), -6 * x * y, 0);
#endif
    return g;
}
