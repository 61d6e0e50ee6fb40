/* Short sums, and one system of some tens of unknowns. */
#ifndef GPEBO_ELEMENTS_H
#define GPEBO_ELEMENTS_H

#include "kernel.h"

/* `combine` for a fixed number of columns. */
#define COMBINE(block)                                                                             \
    for (; j + block <= width; j += block) {                                                       \
        double sum[block];                                                                         \
        for (int c = 0; c < block; c++)                                                            \
            sum[c] = initial ? initial[j + c] : 0.0;                                               \
        for (npy_intp e = 0; e < inner; e++)                                                       \
            for (int c = 0; c < block; c++)                                                        \
                sum[c] += a[e] * b[e * step + j + c];                                              \
        for (int c = 0; c < block; c++)                                                            \
            out[j + c] = sum[c];                                                                   \
    }

/* out (width,) = initial (width,) or zero + the sum of a[e] times row e of b, rows `step` apart.
   Sums stay in registers: nearly all matrices here are narrow. */
static inline void combine(double *out, const double *initial, const double *a, npy_intp inner,
                           const double *b, npy_intp step, npy_intp width)
{
    npy_intp j = 0;
    COMBINE(16)
    COMBINE(8)
    COMBINE(4)
    COMBINE(1)
}

/* size (width,): at least the largest number of each column of values (rows, width). */
static inline void enlarge(double *restrict size, const double *restrict values, npy_intp rows,
                           npy_intp width)
{
    for (npy_intp i = 0; i < rows; i++, values += width)
        for (npy_intp j = 0; j < width; j++)
            size[j] = larger(size[j], fabs(values[j]));
}

/* The largest of `least` and all values (count,); what is not a number stays. */
static inline double largest_of(double least, const double *values, npy_intp count)
{
    double most[4] = {least, least, least, least};
    npy_intp i = 0;
    for (; i + 4 <= count; i += 4)
        for (int c = 0; c < 4; c++)
            most[c] = larger(most[c], values[i + c]);
    for (; i < count; i++)
        most[0] = larger(most[0], values[i]);
    return larger(larger(most[0], most[1]), larger(most[2], most[3]));
}

/* |last Legendre coefficients| (rows, C) of the point values (points, C) of one element. */
static inline void last_coefficients(double *out, const double *to_legendre, const double *values,
                                     npy_intp rows, npy_intp points, npy_intp C)
{
    for (npy_intp j = 0; j < rows; j++)
        combine(out + j * C, NULL, to_legendre + j * points, points, values, C, C);
    for (npy_intp c = 0; c < rows * C; c++)
        out[c] = fabs(out[c]);
}

/* Columns are eliminated in panels of so many, and right-hand sides solved for so many at once. */
#define PANEL 4
#define SIDES 8

/* Length of the rows of [A | B] for A (m, m) and B (m, columns): whole blocks of both. */
static inline npy_intp row_length(npy_intp m, npy_intp columns)
{
    const npy_intp sides = (columns + SIDES - 1) / SIDES * SIDES;
    return (m + sides + PANEL - 1) / PANEL * PANEL;
}

/* Solves A X = B by elimination with row pivoting. W holds [A | B | 0] in m rows of
   row_length(m, columns) numbers; A is destroyed and B becomes X. 0 if a pivot is exactly zero. */
int eliminate(double *W, npy_intp m, npy_intp columns);

#endif
