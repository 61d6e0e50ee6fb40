/* Elimination for systems of some tens of unknowns: what LAPACK does, without its calls. */
#include "elements.h"

#define PANEL 4 /* columns eliminated at once: so many rows are subtracted in one pass */

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
        for (npy_intp i = c + 1; i < m; i++) {
            double *restrict row = W + i * length;
            const double factor = row[c] / pivot[c];
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

/* X of U X = B for `SIDES` columns of B from `place` on. */
static inline void back_substitute(double *W, npy_intp m, npy_intp length, npy_intp place)
{
    for (npy_intp i = m - 1; i >= 0; i--) {
        const double *restrict row = W + i * length;
        double sum[SIDES];
        for (int c = 0; c < SIDES; c++)
            sum[c] = row[place + c];
        for (npy_intp j = i + 1; j < m; j++) {
            const double factor = row[j];
            const double *restrict later = W + j * length + place;
            for (int c = 0; c < SIDES; c++)
                sum[c] -= factor * later[c];
        }
        for (int c = 0; c < SIDES; c++)
            W[i * length + place + c] = sum[c] / row[i];
    }
}

EVERY_WIDTH int eliminate(double *W, npy_intp m, npy_intp columns)
{
    const npy_intp length = row_length(m, columns);
    for (npy_intp k = 0; k < m; k += PANEL) {
        const npy_intp width = m - k < PANEL ? m - k : PANEL, next = k + width;
        if (!factor_panel(W, m, length, k, width))
            return 0;
        finish_rows(W, length, k, width);
        if (width < PANEL)
            break; /* the last one: nothing is below */
        const double *restrict u0 = W + k * length, *restrict u1 = u0 + length;
        const double *restrict u2 = u1 + length, *restrict u3 = u2 + length;
        npy_intp i = next;
        for (; i + 1 < m; i += 2) {
            double *restrict one = W + i * length, *restrict two = one + length;
            const double a0 = one[k], a1 = one[k + 1], a2 = one[k + 2], a3 = one[k + 3];
            const double b0 = two[k], b1 = two[k + 1], b2 = two[k + 2], b3 = two[k + 3];
            for (npy_intp j = next; j < length; j++) {
                one[j] = one[j] - a0 * u0[j] - a1 * u1[j] - a2 * u2[j] - a3 * u3[j];
                two[j] = two[j] - b0 * u0[j] - b1 * u1[j] - b2 * u2[j] - b3 * u3[j];
            }
        }
        for (; i < m; i++) {
            double *restrict row = W + i * length;
            const double a0 = row[k], a1 = row[k + 1], a2 = row[k + 2], a3 = row[k + 3];
            for (npy_intp j = next; j < length; j++)
                row[j] = row[j] - a0 * u0[j] - a1 * u1[j] - a2 * u2[j] - a3 * u3[j];
        }
    }
    for (npy_intp place = m; place < length; place += SIDES)
        back_substitute(W, m, length, place);
    return 1;
}
