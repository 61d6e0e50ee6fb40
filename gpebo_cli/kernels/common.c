#include "common.h"

#include <stdarg.h>

int begin(Call *call, PyObject *const *given, Py_ssize_t count, Py_ssize_t expected)
{
    call->given = given;
    call->count = count;
    call->used = 0;
    if (count == expected)
        return 1;
    PyErr_Format(PyExc_TypeError, "%zd arguments, expected %zd", count, expected);
    return 0;
}

static PyArrayObject *keep(Call *call, PyObject *made)
{
    if (made == NULL)
        return NULL;
    if (call->used == MOST_HELD) {
        Py_DECREF(made);
        PyErr_SetString(PyExc_SystemError, "a kernel holds too many arrays");
        return NULL;
    }
    call->held[call->used++] = made;
    return (PyArrayObject *)made;
}

static PyArrayObject *argument(Call *call, Py_ssize_t place, int axes, int type)
{
    PyObject *given = call->given[place];
    if (!PyArray_Check(given) || PyArray_NDIM((PyArrayObject *)given) != axes ||
        PyArray_TYPE((PyArrayObject *)given) != type) {
        PyErr_Format(PyExc_TypeError, "argument %zd must be an array of %s with %d axes", place,
                     type == NPY_DOUBLE ? "float64" : "intp", axes);
        return NULL;
    }
    return keep(call, PyArray_FROM_OF(given, NPY_ARRAY_CARRAY_RO));
}

PyArrayObject *doubles(Call *call, Py_ssize_t place, int axes)
{
    return argument(call, place, axes, NPY_DOUBLE);
}

PyArrayObject *indices(Call *call, Py_ssize_t place, int axes)
{
    return argument(call, place, axes, NPY_INTP);
}

int number(Call *call, Py_ssize_t place, double *value)
{
    *value = PyFloat_AsDouble(call->given[place]);
    return !(*value == -1.0 && PyErr_Occurred() != NULL);
}

int whole_number(Call *call, Py_ssize_t place, npy_intp *value)
{
    *value = PyLong_AsSsize_t(call->given[place]);
    return !(*value == -1 && PyErr_Occurred() != NULL);
}

PyArrayObject *fresh(Call *call, int axes, const npy_intp *shape)
{
    return keep(call, PyArray_SimpleNew(axes, (npy_intp *)shape, NPY_DOUBLE));
}

PyArrayObject *zeros(Call *call, int axes, const npy_intp *shape)
{
    return keep(call, PyArray_ZEROS(axes, (npy_intp *)shape, NPY_DOUBLE, 0));
}

PyArrayObject *fresh_indices(Call *call, npy_intp length)
{
    return keep(call, PyArray_SimpleNew(1, &length, NPY_INTP));
}

double *old_scratch(Call *call, size_t numbers)
{
    npy_intp length = numbers ? (npy_intp)numbers : 1;
    PyArrayObject *memory = fresh(call, 1, &length);
    return memory == NULL ? NULL : data(memory);
}

int *integers(Call *call, size_t numbers)
{
    npy_intp length = numbers ? (npy_intp)numbers : 1;
    PyArrayObject *memory = keep(call, PyArray_SimpleNew(1, &length, NPY_INT));
    return memory == NULL ? NULL : (int *)PyArray_DATA(memory);
}

static void release(Call *call)
{
    while (call->used)
        Py_DECREF(call->held[--call->used]);
}

PyObject *failed(Call *call)
{
    release(call);
    return NULL;
}

PyObject *no_answer(Call *call)
{
    release(call);
    Py_RETURN_NONE;
}

PyObject *one_number(Call *call, double value)
{
    release(call);
    return PyFloat_FromDouble(value);
}

PyObject *results(Call *call, int count, ...)
{
    PyObject *answer = NULL;
    va_list list;
    va_start(list, count);
    if (count == 1) {
        answer = va_arg(list, PyObject *);
        Py_INCREF(answer);
    } else if ((answer = PyTuple_New(count)) != NULL) {
        for (int i = 0; i < count; i++) {
            PyObject *one = va_arg(list, PyObject *);
            Py_INCREF(one);
            PyTuple_SetItem(answer, i, one);
        }
    }
    va_end(list);
    release(call);
    return answer;
}

int same(const char *what, npy_intp one, npy_intp other)
{
    if (one == other)
        return 1;
    PyErr_Format(PyExc_ValueError, "%s: %zd and %zd", what, (Py_ssize_t)one, (Py_ssize_t)other);
    return 0;
}

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
