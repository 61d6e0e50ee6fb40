/* Eigenvalues of small symmetric matrices. */
#include "kernel.h"

/* The power of two that brings the largest of some numbers below one; 0 if one is not finite. */
static double unit(const double *A, npy_intp numbers)
{
    double most = 0.0;
    for (npy_intp i = 0; i < numbers; i++) {
        if (!isfinite(A[i]))
            return 0.0;
        most = fabs(A[i]) > most ? fabs(A[i]) : most;
    }
    int exponent = 0;
    frexp(most, &exponent);
    return ldexp(1.0, exponent > 1000 ? -1000 : exponent < -1000 ? 1000 : -exponent);
}

/* A symmetric A (p, p), of which the lower triangle counts and is destroyed, made tridiagonal by
   Householder's reflections, the last row first: diagonal d (p,), beside it e (p,) with e[i]
   between i and i + 1. */
static void tridiagonal(double *restrict A, npy_intp p, double *restrict d, double *restrict e)
{
    for (npy_intp i = p - 1; i > 0; i--) {
        double *restrict v = A + i * p, square = 0.0;
        for (npy_intp k = 0; k < i - 1; k++)
            square += v[k] * v[k];
        if (square == 0.0) { /* nothing to reflect */
            e[i - 1] = v[i - 1];
            continue;
        }
        const double edge = v[i - 1], norm = sqrt(square + edge * edge);
        e[i - 1] = edge >= 0.0 ? -norm : norm;
        v[i - 1] = edge - e[i - 1]; /* reflects along v, with vᵀv = 2 half */
        const double half = norm * (norm + fabs(edge));
        double along = 0.0;
        for (npy_intp j = 0; j < i; j++) {
            double sum = 0.0;
            for (npy_intp k = 0; k <= j; k++)
                sum += A[j * p + k] * v[k];
            for (npy_intp k = j + 1; k < i; k++)
                sum += A[k * p + j] * v[k];
            d[j] = sum / half;
            along += d[j] * v[j];
        }
        along /= 2.0 * half;
        for (npy_intp j = 0; j < i; j++) {
            d[j] -= along * v[j];
            for (npy_intp k = 0; k <= j; k++)
                A[j * p + k] -= v[j] * d[k] + d[j] * v[k];
        }
    }
    for (npy_intp i = 0; i < p; i++)
        d[i] = A[i * p + i];
}

#define STEPS 60 /* for one eigenvalue; two are what it takes */

/* Eigenvalues of the tridiagonal matrix with diagonal d (p,), which they replace, and e (p,)
   beside it, which is destroyed: the QL algorithm with implicit shifts. */
static void tridiagonal_ql(double *restrict d, double *restrict e, npy_intp p)
{
    for (npy_intp low = 0; low < p; low++)
        for (int step = 0; step < STEPS; step++) {
            npy_intp high = low;
            while (high < p - 1 &&
                   fabs(e[high]) > 0.5 * DBL_EPSILON * (fabs(d[high]) + fabs(d[high + 1])))
                high++;
            if (high == low)
                break;
            double g = (d[low + 1] - d[low]) / (2.0 * e[low]), r = sqrt(g * g + 1.0);
            g = d[high] - d[low] + e[low] / (g >= 0.0 ? g + r : g - r);
            double sine = 1.0, cosine = 1.0, shift = 0.0;
            npy_intp i = high - 1;
            for (; i >= low; i--) {
                const double f = sine * e[i], b = cosine * e[i];
                r = sqrt(f * f + g * g);
                if (i < p - 1)
                    e[i + 1] = r;
                if (r == 0.0) {
                    d[i + 1] -= shift;
                    e[high] = 0.0;
                    break;
                }
                const double inverse = 1.0 / r;
                sine = f * inverse;
                cosine = g * inverse;
                g = d[i + 1] - shift;
                r = (d[i] - g) * sine + 2.0 * cosine * b;
                shift = sine * r;
                d[i + 1] = g + shift;
                g = cosine * r - b;
            }
            if (i >= low)
                continue;
            d[low] -= shift;
            e[low] = g;
            e[high] = 0.0;
        }
}

/* Puts a value among the first `count` of `out`, which are ascending. */
static void insert(double *out, npy_intp count, double value)
{
    for (; count > 0 && out[count - 1] > value; count--)
        out[count] = out[count - 1];
    out[count] = value;
}

/* Eigenvalues of the symmetric A (p, p), of which the lower triangle counts, ascending to `out`
   (p,), to rounding in the largest; A is destroyed, `beside` is (p,). 0 if A is not finite. */
static int eigenvalues_of(double *restrict A, npy_intp p, double *restrict out,
                          double *restrict beside)
{
    for (npy_intp i = 0; i < p; i++)
        for (npy_intp j = 0; j < i; j++)
            A[j * p + i] = A[i * p + j];
    const double scale = unit(A, p * p);
    if (scale == 0.0)
        return 0;
    for (npy_intp i = 0; i < p * p; i++)
        A[i] *= scale;
    tridiagonal(A, p, out, beside);
    tridiagonal_ql(out, beside, p);
    const double back = 1.0 / scale; /* a power of two */
    for (npy_intp i = 0; i < p; i++)
        insert(out, i, out[i] * back);
    return 1;
}

/* A (N, p, c ≥ p) -> eigenvalues of the left squares, whose lower triangles count, ascending. */
static Outcome eigenvalues(Call *call)
{
    const npy_intp N = SIZE(N), p = SIZE(p), c = SIZE(c);
    if (c < p)
        return refused("columns of a square", c);
    double *work = scratch(call, p * p + p);
    if (work == NULL)
        return ERROR;
    for (npy_intp k = 0; k < N; k++) {
        for (npy_intp i = 0; i < p; i++)
            memcpy(work + i * p, call->in[0] + (k * p + i) * c, p * sizeof(double));
        if (!eigenvalues_of(work, p, call->out[0] + k * p, work + p * p))
            return DECLINED;
    }
    return DONE;
}

const Kernel spectrum_kernels[] = {
    {"eigenvalues", "Npc", "Np", eigenvalues},
    {NULL, NULL, NULL, NULL},
};
