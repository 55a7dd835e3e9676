// Adam on the few numbers of a view, by one work-item.

// One step of Adam (Kingma & Ba 2015) on a row of `count` numbers, whose `step`-th it is; the bias
// corrections go from log(beta): in single precision 1 - 0.999^t loses digits.
inline void adam_row(const real *gradient, int count, uint step, real rate, __global real *values,
                     __global real *m, __global real *v)
{
    const real correction1 = -expm1(step * (real)LOG_BETA1);
    const real correction2 = -expm1(step * (real)LOG_BETA2);
    for (int k = 0; k < count; k++) {
        const real g = gradient[k];
        m[k] += (real)ONE_MINUS_BETA1 * (g - m[k]);
        v[k] += (real)ONE_MINUS_BETA2 * (g * g - v[k]);
        values[k] -= rate * (m[k] / correction1) / (sqrt(v[k] / correction2) + (real)ADAM_EPSILON);
    }
}
