/* Small matrices by rows: reflections, rotations, and what they make of them. */
#ifndef GPEBO_ORTHOGONAL_H
#define GPEBO_ORTHOGONAL_H

#include "kernel.h"

static inline double dot(const double *x, const double *y, npy_intp length)
{
    double sum = 0.0;
    for (npy_intp i = 0; i < length; i++)
        sum += x[i] * y[i];
    return sum;
}

static inline double norm(const double *x, npy_intp length)
{
    return sqrt(dot(x, x, length)) + DBL_MIN;
}

/* W (rows, length), rows ≤ length, becomes P W = L Qᵀ by Householder's reflections: L, lower
   triangular, is left in W, and in `mirrors` (rows, length) the vectors v of Q = Π (I − v vᵀ).
   With `order` (rows,) the row with the most left comes next, order[k] being the one that came
   k-th; without it, rows stay where they are. */
void triangularise(double *W, npy_intp rows, npy_intp length, double *mirrors, npy_intp *order);

/* Columns `from` … length − 1 of Q as rows of out (length − from, length). */
void columns_of_q(const double *mirrors, npy_intp rows, npy_intp length, npy_intp from,
                  double *out);

/* Rotates the rows of W (rows, length) among themselves until they are orthogonal (one-sided
   Jacobi); their lengths, sigma (rows,), are its singular values. 0 where it does not settle. */
int orthogonalise(double *W, npy_intp rows, npy_intp length, double *sigma);

/* Sorts sigma (count,) from large to small, and the rows of W (count, length) with it. */
void sort_down(double *sigma, double *W, npy_intp count, npy_intp length);

#endif
