/* Small matrices at LANES times at once: what is one number at one time is LANES in a row, so that
   innermost loops have a length that the compiler knows, and entries that are zero at all these
   times cost nothing. A "row length" is the distance between rows, in entries. */
#ifndef GPEBO_LANES_H
#define GPEBO_LANES_H

#include "kernel.h"

#define LANES 8
typedef double Lane[LANES];
/* What is done in one lane needs no other one. */
#define EACH _Pragma("omp simd") for (int l = 0; l < LANES; l++)

/* Whether an entry is zero at all times; NaN is not. */
static inline int is_zero(const double *a)
{
    double sum = 0.0;
    for (int l = 0; l < LANES; l++)
        sum += fabs(a[l]);
    return sum == 0.0;
}

/* Memory for `count` matrices of so many entries each; 0 with an exception. */
int lanes_scratch(Call *call, const npy_intp *sizes, Lane ***parts, size_t count);
#define LENGTH(array) (sizeof(array) / sizeof((array)[0]))

static inline void lanes_clear(Lane *out, npy_intp entries)
{
    memset(out, 0, entries * sizeof(Lane));
}

/* `entries` at the times first … first + used − 1, `step` numbers apart; what is left of the lanes
   repeats the last time. */
void lanes_load(Lane *to, const double *from, npy_intp step, npy_intp entries, npy_intp first,
                npy_intp used);

/* `columns` of each row of (rows, width) entries from `column` on, into (times, rows, columns). */
void lanes_store(double *to, const Lane *from, npy_intp rows, npy_intp width, npy_intp column,
                 npy_intp columns, npy_intp first, npy_intp used);

/* What becomes of C: the product, or what it was with the product added or taken away. */
typedef enum { SET, ADD, SUBTRACT } How;

/* C (rows, columns) and A B, A (rows, inner), B (inner, columns), of row lengths c, a, b; the
   entries of A may be any numbers `down` and `right` apart. */
void lanes_product(Lane *C, npy_intp c, const Lane *A, npy_intp down, npy_intp right, const Lane *B,
                   npy_intp b, npy_intp rows, npy_intp inner, npy_intp columns, How how);
#define lanes_multiply(C, c, A, a, ...) lanes_product(C, c, A, a, 1, __VA_ARGS__)

/* C = M A with M (rows, inner) the same at all times, its numbers `down` and `right` apart. */
void lanes_from_left(Lane *C, npy_intp c, const double *M, npy_intp down, npy_intp right,
                     const Lane *A, npy_intp rows, npy_intp inner, npy_intp columns);

/* C = A M with M (inner, columns) the same at all times. */
void lanes_from_right(Lane *C, npy_intp c, const Lane *A, const double *M, npy_intp rows,
                      npy_intp inner, npy_intp columns);

/* A X = B by elimination with row pivoting in each lane: B (n, columns) becomes X, A (n, n) is
   destroyed and has the pivots' reciprocals on its diagonal; sign is that of the exchanges. Where
   A is singular the result is not finite. */
void lanes_solve(Lane *A, Lane *B, npy_intp n, npy_intp columns, double *sign);

/* Q R = A with orthonormal Q (rows, columns) in the place of A and X = R⁻¹, by Gram-Schmidt,
   twice. Where A is rank-deficient X is large, or not finite. */
void lanes_qr(Lane *A, Lane *R, Lane *X, npy_intp rows, npy_intp columns);

/* Frobenius norms. */
void lanes_norm(double *out, const Lane *A, npy_intp entries);

#endif
