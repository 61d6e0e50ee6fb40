/* Elimination for systems of some tens of unknowns: what LAPACK does, without its calls. */
#include "elements.h"

/* The row from `first` on with the largest number in a column of W. */
static inline npy_intp largest_in(const double *column, npy_intp m, npy_intp length, npy_intp first)
{
    double largest = fabs(column[first * length]), other = 0.0;
    npy_intp best = first, i = first + 1, second = first;
    for (; i + 1 < m; i += 2) { /* even and odd rows apart: one need not wait for the other */
        const double one = fabs(column[i * length]), two = fabs(column[(i + 1) * length]);
        best = one > largest ? i : best;
        largest = one > largest ? one : largest;
        second = two > other ? i + 1 : second;
        other = two > other ? two : other;
    }
    if (i < m && fabs(column[i * length]) > largest) {
        largest = fabs(column[i * length]);
        best = i;
    }
    return other > largest ? second : best;
}

/* Eliminates column `c` of the panel at k (0 ≤ c < PANEL, a constant) from the rows below row
   k + c, within the panel; 0 if its pivot is zero. Rows are swapped as a whole; factors stay where
   zeros would be. */
static inline int eliminate_column(double *W, npy_intp m, npy_intp length, npy_intp k, int c)
{
    double *pivot = W + (k + c) * length + k;
    const npy_intp best = largest_in(W + k + c, m, length, k + c);
    if (best != k + c)
        swap_rows(pivot, W + best * length + k, length - k);
    if (pivot[c] == 0.0)
        return 0;
    const double reciprocal = 1.0 / pivot[c];
    const int divide = !(fabs(reciprocal) <= DBL_MAX);
    double taken[PANEL];
    memcpy(taken, pivot, sizeof(taken));
    for (npy_intp i = k + c + 1; i < m; i++) {
        double *row = W + i * length + k;
        const double factor = divide ? row[c] / taken[c] : row[c] * reciprocal;
        row[c] = factor;
        for (int j = c + 1; j < PANEL; j++)
            row[j] -= factor * taken[j];
    }
    return 1;
}

/* The first `width` columns of the panel at k, all of whose columns are brought up to date. */
static inline int factor_panel(double *W, npy_intp m, npy_intp length, npy_intp k, npy_intp width)
{
    return eliminate_column(W, m, length, k, 0) &&
           (width < 2 || eliminate_column(W, m, length, k, 1)) &&
           (width < 3 || eliminate_column(W, m, length, k, 2)) &&
           (width < 4 || eliminate_column(W, m, length, k, 3));
}

/* row −= factor other, from column j on. */
static inline void subtract(double *restrict row, double factor, const double *restrict other,
                            npy_intp j, npy_intp length)
{
    for (; j < length; j++)
        row[j] -= factor * other[j];
}

/* The rows of the panel at k, right of it: each minus what those above take away. */
static inline void finish_rows(double *W, npy_intp length, npy_intp k, npy_intp width)
{
    for (npy_intp c = k + 1; c < k + width; c++)
        for (npy_intp e = k; e < c; e++)
            subtract(W + c * length, W[c * length + e], W + e * length, k + PANEL, length);
}

/* Rows one and two minus what the rows u of the panel at k take away, from column `next` on. */
static inline void take_away(double *restrict one, double *restrict two, const double *restrict u,
                             npy_intp length, npy_intp k, npy_intp next)
{
    const double *restrict u1 = u + length, *restrict u2 = u1 + length, *restrict u3 = u2 + length;
    const double a0 = one[k], a1 = one[k + 1], a2 = one[k + 2], a3 = one[k + 3];
    const double b0 = two[k], b1 = two[k + 1], b2 = two[k + 2], b3 = two[k + 3];
    for (npy_intp j = next; j < length; j++) {
        one[j] = one[j] - a0 * u[j] - a1 * u1[j] - a2 * u2[j] - a3 * u3[j];
        two[j] = two[j] - b0 * u[j] - b1 * u1[j] - b2 * u2[j] - b3 * u3[j];
    }
}

/* The same for all rows first … last − 1. */
static inline void take_all_away(double *W, npy_intp first, npy_intp last, npy_intp length,
                                 npy_intp k, npy_intp next)
{
    npy_intp i = first;
    for (; i + 1 < last; i += 2)
        take_away(W + i * length, W + (i + 1) * length, W + k * length, length, k, next);
    for (; i < last; i++)
        for (npy_intp e = k; e < k + PANEL; e++)
            subtract(W + i * length, W[i * length + e], W + e * length, next, length);
}

/* Rows k … k + width − 1 of X where U X = B and the rows below are solved and taken away. */
static inline void solve_panel(double *W, npy_intp m, npy_intp length, npy_intp k, npy_intp width)
{
    for (npy_intp i = k + width - 1; i >= k; i--) {
        double *restrict row = W + i * length;
        for (npy_intp e = i + 1; e < k + width; e++)
            subtract(row, row[e], W + e * length, m, length);
        const double pivot = row[i];
        for (npy_intp j = m; j < length; j++)
            row[j] /= pivot;
    }
}

EVERY_WIDTH int eliminate(double *W, npy_intp m, npy_intp columns)
{
    const npy_intp length = row_length(m, columns);
    for (npy_intp k = 0; k < m; k += PANEL) { /* the last panel may be narrow: nothing is below */
        const npy_intp width = m - k < PANEL ? m - k : PANEL;
        if (!factor_panel(W, m, length, k, width))
            return 0;
        finish_rows(W, length, k, width);
        take_all_away(W, k + PANEL, m, length, k, k + PANEL);
    }
    npy_intp k = m;
    for (; k >= PANEL; k -= PANEL) {
        solve_panel(W, m, length, k - PANEL, PANEL);
        take_all_away(W, 0, k - PANEL, length, k - PANEL, m);
    }
    solve_panel(W, m, length, 0, k);
    return 1;
}
