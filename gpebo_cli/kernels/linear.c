/* gpebo_cli/linalg.py: small matrices, and recurrences over time. */
#include "common.h"

int solve_in_place(double *A, double *B, npy_intp n, npy_intp columns)
{
    for (npy_intp k = 0; k < n; k++) {
        npy_intp best = k;
        for (npy_intp i = k + 1; i < n; i++)
            if (fabs(A[i * n + k]) > fabs(A[best * n + k]))
                best = i;
        if (A[best * n + k] == 0.0)
            return 0;
        if (best != k) {
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
    return 1;
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

PyMethodDef linear_kernels[] = {
    {"affine_scan", (PyCFunction)(void (*)(void))affine_scan, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};
