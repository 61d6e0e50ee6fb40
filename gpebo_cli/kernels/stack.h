/* Arguments that are stacks of matrices, one per time; for observer.c and excitation.c. */
#ifndef GPEBO_STACK_H
#define GPEBO_STACK_H

#include "common.h"

/* A stack of matrices or vectors, one per time. */
typedef struct {
    PyArrayObject *array;
    double *at;
    npy_intp times;   /* product of the leading axes */
    npy_intp numbers; /* per time */
} Stack;

/* The integer that an argument is; 0 with an exception, also for a negative one. */
static inline int count_of(Call *call, Py_ssize_t place, npy_intp *value)
{
    if (!whole_number(call, place, value))
        return 0;
    if (*value < 0)
        PyErr_Format(PyExc_ValueError, "argument %zd is negative", place);
    return *value >= 0;
}

/* An array with `axes` axes after those of time, which are one, (N, …), or two, (K, s + 1, …). */
static inline int stack(Call *call, Py_ssize_t place, int axes, Stack *out)
{
    PyObject *given = call->given[place];
    const int two = PyArray_Check(given) && PyArray_NDIM((PyArrayObject *)given) == axes + 2;
    out->array = doubles(call, place, axes + 1 + two);
    if (out->array == NULL)
        return 0;
    out->at = data(out->array);
    out->times = size(out->array, 0) * (two ? size(out->array, 1) : 1);
    out->numbers = 1;
    for (int i = 0; i < axes; i++)
        out->numbers *= size(out->array, 1 + two + i);
    return 1;
}

/* Length of an axis after those of time, counted from the end: 1 is the last one. */
static inline npy_intp last(const Stack *one, int axis)
{
    return size(one->array, PyArray_NDIM(one->array) - axis);
}

/* Whether a stack has as many times as it should, or one. */
static inline int lasting(const char *what, const Stack *one, npy_intp times)
{
    return one->times == 1 || same(what, one->times, times);
}

#endif
