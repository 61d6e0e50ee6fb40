/* Elimination for systems of some tens of unknowns: what LAPACK does, without its calls. */
#include "elements.h"

#include <float.h>

/* Rows a and b of W change places, from a column on. */
static inline void swap_rows(double *restrict a, double *restrict b, npy_intp from, npy_intp length)
{
    for (npy_intp j = from; j < length; j++) {
        const double kept = a[j];
        a[j] = b[j];
        b[j] = kept;
    }
}

/* Factors of columns k … k + width of W (m rows of `length`) below the diagonal, rows swapped as
   a whole; only these columns are changed otherwise. 0 if a pivot is zero. */
static inline int factor_panel(double *W, npy_intp m, npy_intp length, npy_intp k, npy_intp width)
{
    for (npy_intp c = k; c < k + width; c++) {
        npy_intp best = c;
        double largest = fabs(W[c * length + c]);
        for (npy_intp i = c + 1; i < m; i++) {
            const double one = fabs(W[i * length + c]);
            if (one > largest) {
                largest = one;
                best = i;
            }
        }
        if (largest == 0.0)
            return 0;
        if (best != c)
            swap_rows(W + c * length, W + best * length, k, length);
        const double *restrict pivot = W + c * length;
        const double reciprocal = 1.0 / pivot[c];
        const int divide = !(fabs(reciprocal) <= DBL_MAX);
        for (npy_intp i = c + 1; i < m; i++) {
            double *restrict row = W + i * length;
            const double factor = divide ? row[c] / pivot[c] : row[c] * reciprocal;
            row[c] = factor;
            for (npy_intp j = c + 1; j < k + width; j++)
                row[j] -= factor * pivot[j];
        }
    }
    return 1;
}

/* The rows of a panel at k of `width`, right of it: each minus what those above take away. */
static inline void finish_rows(double *W, npy_intp length, npy_intp k, npy_intp width)
{
    for (npy_intp c = k + 1; c < k + width; c++) {
        double *restrict row = W + c * length;
        for (npy_intp e = k; e < c; e++) {
            const double factor = row[e];
            const double *restrict above = W + e * length;
            for (npy_intp j = k + width; j < length; j++)
                row[j] -= factor * above[j];
        }
    }
}

/* X of U X = B for `SIDES` columns of B from `place` on; two sums, so that one need not wait for
   the other. */
static inline void back_substitute(double *W, npy_intp m, npy_intp length, npy_intp place)
{
    for (npy_intp i = m - 1; i >= 0; i--) {
        const double *restrict row = W + i * length;
        double sum[SIDES], other[SIDES] = {0.0};
        for (int c = 0; c < SIDES; c++)
            sum[c] = row[place + c];
        npy_intp j = i + 1;
        for (; j + 1 < m; j += 2) {
            const double factor = row[j], next = row[j + 1];
            const double *restrict later = W + j * length + place, *restrict last = later + length;
            for (int c = 0; c < SIDES; c++) {
                sum[c] -= factor * later[c];
                other[c] -= next * last[c];
            }
        }
        for (; j < m; j++)
            for (int c = 0; c < SIDES; c++)
                sum[c] -= row[j] * W[j * length + place + c];
        for (int c = 0; c < SIDES; c++)
            W[i * length + place + c] = (sum[c] + other[c]) / row[i];
    }
}

/* Rows one and two minus what the rows u of a panel take away, from column `next` on. */
static inline void take_away(double *restrict one, double *restrict two, const double *restrict u,
                             npy_intp length, npy_intp k, npy_intp next)
{
    const double *restrict u1 = u + length, *restrict u2 = u1 + length, *restrict u3 = u2 + length;
    const double a0 = one[k], a1 = one[k + 1], a2 = one[k + 2], a3 = one[k + 3];
    const double b0 = two[k], b1 = two[k + 1], b2 = two[k + 2], b3 = two[k + 3];
    for (npy_intp j = next; j < length; j += PANEL)
        for (int c = 0; c < PANEL; c++) {
            one[j + c] = one[j + c] - a0 * u[j + c] - a1 * u1[j + c] - a2 * u2[j + c] -
                         a3 * u3[j + c];
            two[j + c] = two[j + c] - b0 * u[j + c] - b1 * u1[j + c] - b2 * u2[j + c] -
                         b3 * u3[j + c];
        }
}

EVERY_WIDTH int eliminate(double *W, npy_intp m, npy_intp columns)
{
    const npy_intp length = row_length(m, columns);
    for (npy_intp k = 0; k < m; k += PANEL) {
        const npy_intp width = m - k < PANEL ? m - k : PANEL, next = k + PANEL;
        if (!factor_panel(W, m, length, k, width))
            return 0;
        finish_rows(W, length, k, width);
        npy_intp i = next;
        for (; i + 1 < m; i += 2)
            take_away(W + i * length, W + (i + 1) * length, W + k * length, length, k, next);
        for (; i < m; i++) {
            double *restrict row = W + i * length;
            for (npy_intp e = k; e < next; e++) {
                const double factor = row[e];
                const double *restrict u = W + e * length;
                for (npy_intp j = next; j < length; j++)
                    row[j] -= factor * u[j];
            }
        }
    }
    for (npy_intp place = m; place + SIDES <= length; place += SIDES)
        back_substitute(W, m, length, place);
    return 1;
}
