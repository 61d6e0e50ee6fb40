/* What all kernels share: how arguments come in, how results go out, and small matrices. */
#ifndef GPEBO_COMMON_H
#define GPEBO_COMMON_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#define NPY_NO_DEPRECATED_API NPY_1_7_API_VERSION
#define PY_ARRAY_UNIQUE_SYMBOL gpebo_numpy_api
#ifndef GPEBO_MODULE
#define NO_IMPORT_ARRAY
#endif
#include <numpy/arrayobject.h>

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* One version of a function for each width of the processor's registers, chosen when the module
   is loaded. All round alike: no loop adds up in another order, nothing is contracted. */
#if defined(__has_attribute) && defined(__x86_64__) && defined(__GLIBC__) && !defined(GPEBO_PLAIN)
#if __has_attribute(target_clones)
#define EVERY_WIDTH __attribute__((target_clones("avx512f", "avx2", "default")))
#endif
#endif
#ifndef EVERY_WIDTH
#define EVERY_WIDTH
#endif

/* Arguments of one call, and results under way: whatever happens, `release` gives all back. */
#define MOST_HELD 48
typedef struct {
    PyObject *const *given; /* the arguments of the call */
    Py_ssize_t count;       /* how many */
    PyObject *held[MOST_HELD];
    int used;
} Call;

/* Starts a call that takes `expected` arguments; 0, with an exception, if there are others. */
int begin(Call *call, PyObject *const *given, Py_ssize_t count, Py_ssize_t expected);

/* An argument as a C-contiguous array of float64 (or intp) with `axes` axes, NULL with an
   exception if it is none. Contiguous arrays are not copied. */
PyArrayObject *doubles(Call *call, Py_ssize_t place, int axes);
PyArrayObject *indices(Call *call, Py_ssize_t place, int axes);

/* An argument that is a number, or a whole one; 0 with an exception if it is none. */
int number(Call *call, Py_ssize_t place, double *value);
int whole_number(Call *call, Py_ssize_t place, npy_intp *value);

/* A new array for a result, with nothing in it, or zeros; NULL with an exception. */
PyArrayObject *fresh(Call *call, int axes, const npy_intp *shape);
PyArrayObject *zeros(Call *call, int axes, const npy_intp *shape);

/* A new array of intp with one axis, with nothing in it. */
PyArrayObject *fresh_indices(Call *call, npy_intp length);

/* Memory that lives as long as the call; NULL with an exception. */
double *old_scratch(Call *call, size_t numbers);
int *integers(Call *call, size_t numbers);

/* Ends a call without a result, with None for one, or with a number. */
PyObject *failed(Call *call);
PyObject *no_answer(Call *call);
PyObject *one_number(Call *call, double value);
/* Ends a call with results: some of its arrays, as a tuple unless it is one. */
PyObject *results(Call *call, int count, ...);

/* Whether two sizes agree; an exception that names what if not. */
int same(const char *what, npy_intp one, npy_intp other);

static inline double *data(PyArrayObject *array) { return (double *)PyArray_DATA(array); }
static inline npy_intp size(PyArrayObject *array, int axis) { return PyArray_DIM(array, axis); }

/* The larger one; what is not a number stays. */
static inline double larger(double a, double b) { return a >= b || a != a ? a : b; }

/* Solves A X = B by elimination with row pivoting, A (n, n) and B (n, columns) by rows; A is
   left with the pivots on its diagonal and B becomes X. Returns the sign of the exchanges, ±1, or 0
   if a pivot is exactly zero. For small n: what LAPACK spends on looking at its arguments is more
   than what there is to do. */
int solve_in_place(double *A, double *B, npy_intp n, npy_intp columns);

/* C = A B for matrices by rows, A (rows, inner), B (inner, columns); C may be neither. */
static inline void multiply(double *restrict C, const double *restrict A, const double *restrict B,
                            npy_intp rows, npy_intp inner, npy_intp columns)
{
    for (npy_intp i = 0; i < rows; i++) {
        double *restrict row = C + i * columns;
        for (npy_intp j = 0; j < columns; j++)
            row[j] = 0.0;
        for (npy_intp k = 0; k < inner; k++) {
            const double a = A[i * inner + k];
            const double *restrict b = B + k * columns;
            for (npy_intp j = 0; j < columns; j++)
                row[j] += a * b[j];
        }
    }
}

/* An entry in the table of a file; each file is added to the module in module.c. */
#define KERNEL(name) {#name, (PyCFunction)(void (*)(void))name, METH_FASTCALL, NULL}
extern PyMethodDef jets_kernels[], intervals_kernels[];

#endif
