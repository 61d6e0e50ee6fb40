/* gpebo_cli/numerics/linalg.py: small matrices, and recurrences over time. */
#include "common.h"

int solve_in_place(double *A, double *B, npy_intp n, npy_intp columns)
{
    int sign = 1;
    for (npy_intp k = 0; k < n; k++) {
        npy_intp best = k;
        for (npy_intp i = k + 1; i < n; i++)
            if (fabs(A[i * n + k]) > fabs(A[best * n + k]))
                best = i;
        if (A[best * n + k] == 0.0)
            return 0;
        if (best != k) {
            sign = -sign;
            for (npy_intp j = k; j < n; j++) {
                const double kept = A[k * n + j];
                A[k * n + j] = A[best * n + j];
                A[best * n + j] = kept;
            }
            for (npy_intp j = 0; j < columns; j++) {
                const double kept = B[k * columns + j];
                B[k * columns + j] = B[best * columns + j];
                B[best * columns + j] = kept;
            }
        }
        const double *restrict pivot = A + k * n, *restrict known = B + k * columns;
        for (npy_intp i = k + 1; i < n; i++) {
            double *restrict row = A + i * n, *restrict right = B + i * columns;
            if (row[k] == 0.0)
                continue;
            const double factor = row[k] / pivot[k];
            for (npy_intp j = k + 1; j < n; j++)
                row[j] -= factor * pivot[j];
            for (npy_intp j = 0; j < columns; j++)
                right[j] -= factor * known[j];
        }
    }
    for (npy_intp k = n - 1; k >= 0; k--) {
        double *restrict solved = B + k * columns;
        for (npy_intp i = k + 1; i < n; i++) {
            const double a = A[k * n + i];
            const double *restrict later = B + i * columns;
            for (npy_intp j = 0; j < columns; j++)
                solved[j] -= a * later[j];
        }
        const double pivot = A[k * n + k];
        for (npy_intp j = 0; j < columns; j++)
            solved[j] /= pivot;
    }
    return sign;
}

static PyObject *affine_scan(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 3))
        return NULL;
    PyArrayObject *factor = doubles(&call, 0, 2), *shift = factor ? doubles(&call, 1, 2) : NULL;
    PyArrayObject *start = shift ? doubles(&call, 2, 1) : NULL;
    if (start == NULL || !same("steps of factor and shift", size(factor, 0), size(shift, 0)) ||
        !same("columns of start and shift", size(start, 0), size(shift, 1)))
        return failed(&call);
    const npy_intp steps = size(shift, 0), lanes = size(shift, 1);
    const npy_intp shared = size(factor, 1) == 1 && lanes != 1;
    if (!shared && !same("columns of factor and shift", size(factor, 1), lanes))
        return failed(&call);
    PyArrayObject *out = fresh(&call, 2, (npy_intp[]){steps + 1, lanes});
    if (out == NULL)
        return failed(&call);
    double *z = data(out);
    memcpy(z, data(start), lanes * sizeof(double));
    for (npy_intp k = 0; k < steps; k++, z += lanes) {
        const double *a = data(factor) + k * (shared ? 1 : lanes), *b = data(shift) + k * lanes;
        for (npy_intp j = 0; j < lanes; j++)
            z[lanes + j] = a[shared ? 0 : j] * z[j] + b[j];
    }
    return results(&call, 1, out);
}

static void swap(double *one, double *other, npy_intp count, npy_intp step)
{
    for (npy_intp i = 0; i < count; i++) {
        const double kept = one[i * step];
        one[i * step] = other[i * step];
        other[i * step] = kept;
    }
}

/* det A, and adj(A) B in place of B, for A (n, n), which is destroyed, and B (n, columns); `order`
   has room for n.

   By elimination with row and column pivoting, P A Q = L U. Of U = [V u; 0 δ] with the smallest
   pivot δ last, adj(U) [c; d] = det(V) [V⁻¹ (δ c − u d); d]: nothing is divided by δ, so that A may
   be singular. If another pivot is zero, nothing but zeros is left, and adj(A) = 0. */
static double adjugate_in_place(double *A, double *B, npy_intp n, npy_intp columns, int *order)
{
    double others = 1.0; /* det(V), with the signs of the permutations */
    for (npy_intp k = 0; k < n; k++)
        order[k] = (int)k;
    for (npy_intp k = 0; k + 1 < n; k++) {
        npy_intp row = k, column = k;
        for (npy_intp i = k; i < n; i++)
            for (npy_intp j = k; j < n; j++)
                if (fabs(A[i * n + j]) > fabs(A[row * n + column]))
                    row = i, column = j;
        if (row != k) {
            swap(A + row * n, A + k * n, n, 1);
            swap(B + row * columns, B + k * columns, columns, 1);
            others = -others;
        }
        if (column != k) {
            swap(A + column, A + k, n, n);
            const int kept = order[column];
            order[column] = order[k];
            order[k] = kept;
            others = -others;
        }
        const double pivot = A[k * n + k];
        if (pivot == 0.0) {
            memset(B, 0, n * columns * sizeof(double));
            return 0.0;
        }
        others *= pivot;
        for (npy_intp i = k + 1; i < n; i++) {
            const double factor = A[i * n + k] / pivot;
            for (npy_intp j = k + 1; j < n; j++)
                A[i * n + j] -= factor * A[k * n + j];
            for (npy_intp j = 0; j < columns; j++)
                B[i * columns + j] -= factor * B[k * columns + j];
        }
    }
    const double last = n ? A[n * n - 1] : 1.0, *d = B + (n ? n - 1 : 0) * columns;
    for (npy_intp k = n - 2; k >= 0; k--)
        for (npy_intp j = 0; j < columns; j++) {
            double c = last * B[k * columns + j] - A[k * n + n - 1] * d[j];
            for (npy_intp i = k + 1; i + 1 < n; i++)
                c -= A[k * n + i] * B[i * columns + j];
            B[k * columns + j] = c / A[k * n + k];
        }
    for (npy_intp i = 0; i < n * columns; i++)
        B[i] *= others;
    for (npy_intp k = 0; k < n; k++) /* rows back in their order */
        while (order[k] != k) {
            const int to = order[k];
            swap(B + k * columns, B + to * columns, columns, 1);
            order[k] = order[to];
            order[to] = to;
        }
    return others * last;
}

#define SWEEPS 60

/* σ_min/σ_max of A (n, n), which is destroyed, 0 for A = 0: rotations make the rows orthogonal
   (one-sided Jacobi), and their lengths are the singular values, each to its own digits. */
static double reciprocal_condition(double *A, npy_intp n)
{
    double largest = 0.0, least = 0.0;
    for (npy_intp i = 0; i < n * n; i++)
        largest = fabs(A[i]) > largest ? fabs(A[i]) : largest;
    if (largest == 0.0 || n == 0)
        return 0.0;
    for (npy_intp i = 0; i < n * n; i++)
        A[i] /= largest;
    int turned = 1;
    for (int sweep = 0; turned && sweep < SWEEPS; sweep++) {
        turned = 0;
        for (npy_intp i = 0; i < n; i++)
            for (npy_intp j = i + 1; j < n; j++) {
                double *restrict a = A + i * n, *restrict b = A + j * n;
                double one = 0.0, other = 0.0, both = 0.0;
                for (npy_intp k = 0; k < n; k++) {
                    one += a[k] * a[k];
                    other += b[k] * b[k];
                    both += a[k] * b[k];
                }
                if (!(fabs(both) > 1e-15 * sqrt(one) * sqrt(other)))
                    continue;
                turned = 1;
                const double ratio = (other - one) / (2.0 * both);
                const double tangent =
                    (ratio < 0.0 ? -1.0 : 1.0) / (fabs(ratio) + sqrt(1.0 + ratio * ratio));
                const double cosine = 1.0 / sqrt(1.0 + tangent * tangent);
                const double sine = cosine * tangent;
                for (npy_intp k = 0; k < n; k++) {
                    const double left = a[k], right = b[k];
                    a[k] = cosine * left - sine * right;
                    b[k] = sine * left + cosine * right;
                }
            }
    }
    largest = 0.0;
    for (npy_intp j = 0; j < n; j++) {
        double square = 0.0;
        for (npy_intp k = 0; k < n; k++)
            square += A[j * n + k] * A[j * n + k];
        largest = square > largest ? square : largest;
        least = j == 0 || square < least ? square : least;
    }
    return sqrt(least) / sqrt(largest);
}

/* Ω (N, p, p), b (N, p, c) -> det Ω (N,), adj(Ω) b (N, p, c), σ_min/σ_max of Ω (N,). */
static PyObject *adjugate_action(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 2))
        return NULL;
    PyArrayObject *omega = doubles(&call, 0, 3), *rhs = omega ? doubles(&call, 1, 3) : NULL;
    if (rhs == NULL || !same("matrices and right sides", size(omega, 0), size(rhs, 0)) ||
        !same("rows and columns", size(omega, 1), size(omega, 2)) ||
        !same("rows of matrices and right sides", size(omega, 1), size(rhs, 1)))
        return failed(&call);
    const npy_intp points = size(omega, 0), p = size(omega, 1), c = size(rhs, 2);
    PyArrayObject *determinant = fresh(&call, 1, &points);
    PyArrayObject *action = determinant ? fresh(&call, 3, (npy_intp[]){points, p, c}) : NULL;
    PyArrayObject *reciprocal = action ? fresh(&call, 1, &points) : NULL;
    double *own = reciprocal ? scratch(&call, p * p) : NULL;
    int *order = own ? integers(&call, p) : NULL;
    if (order == NULL)
        return failed(&call);
    memcpy(data(action), data(rhs), points * p * c * sizeof(double));
    for (npy_intp k = 0; k < points; k++) {
        const double *from = data(omega) + k * p * p;
        memcpy(own, from, p * p * sizeof(double));
        data(determinant)[k] = adjugate_in_place(own, data(action) + k * p * c, p, c, order);
        memcpy(own, from, p * p * sizeof(double));
        data(reciprocal)[k] = reciprocal_condition(own, p);
    }
    return results(&call, 3, determinant, action, reciprocal);
}

PyMethodDef linear_kernels[] = {
    KERNEL(adjugate_action),
    KERNEL(affine_scan),
    {NULL, NULL, 0, NULL},
};
