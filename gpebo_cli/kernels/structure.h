/* The model as the kernels of gpebo_cli/simulation see it; for structure.c and reduction.c. */
#ifndef GPEBO_STRUCTURE_H
#define GPEBO_STRUCTURE_H

#include "common.h"

/* Taylor coefficients (K + 1, N or 1, …) wherever they lie; what is constant in time is read with
   a stride of 0. Strides are in numbers. */
typedef struct {
    const double *at;
    npy_intp orders, times, entries, order, time;
} Series;

/* E and A of a model with the scalings of its rows, states and time, differentiated mu times. */
typedef struct {
    Series E, A;
    const double *rows, *columns; /* (n,) */
    double time;
    npy_intp n, mu, size, times; /* size = (mu + 1) n, times = N */
} Model;

/* What there is to see at one time. */
typedef struct {
    double *e, *a;       /* (mu + 1, n, n) scaled */
    double *M;           /* (size, size) */
    double *W, *mirrors; /* (size, size) */
    double *square;      /* (size, size) */
    double *sigma;       /* (size,) of M, from large to small */
    npy_intp *order;     /* (size,) */
    double *Z2;          /* (a, size) by rows, orthonormal: Z2ᵀ */
    double *A2;          /* (a, n) */
    double *T2;          /* (d, n) by rows: T2ᵀ */
    double *Z1;          /* (d, n) by rows: Z1ᵀ */
    double smallest[3];  /* of M, Â2 and E T2, relative; infinite where there is none */
    npy_intp constraints;
} Look;

/* One argument as a Series with `axes` axes; only matrices that are not by rows are copied. */
int series(Call *call, Py_ssize_t place, int axes, Series *out);

/* Arguments 0 to 5: E, A (K + 1, N or 1, n, n), rows, columns (n,), time and mu. */
int model(Call *call, Model *m);

/* e and a (mu + 1, n, n): the scaled coefficients at time t. */
void scaled(const Model *m, npy_intp t, double *e, double *a);

/* Memory for a look at one time after the other; 0 with an exception. */
int prepare(Call *call, const Model *m, Look *look);

/* Levels at time t, `constraints` < 0: as many as M has singular values that are at most rank_tol
   times its size; `upto` says how many of the three are asked for. 0 where singular values and
   elimination do not see the same rank, or nothing converges: LAPACK has to look. */
int look_at(const Model *m, npy_intp t, npy_intp constraints, double rank_tol, int upto,
            Look *look);

#endif
