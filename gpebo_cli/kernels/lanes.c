#include "lanes.h"

int lanes_scratch(Call *call, const npy_intp *sizes, Lane ***parts, size_t count)
{
    for (size_t i = 0; i < count; i++) /* each by itself: sanitizers see what leaves its own */
        if ((*parts[i] = (Lane *)scratch(call, sizes[i] * LANES)) == NULL)
            return 0;
    return 1;
}

void lanes_load(Lane *to, const double *from, npy_intp step, npy_intp entries, npy_intp first,
                npy_intp used)
{
    for (int l = 0; l < LANES; l++) {
        const double *one = from + (first + (l < used ? l : used - 1)) * step;
        for (npy_intp i = 0; i < entries; i++)
            to[i][l] = one[i];
    }
}

void lanes_store(double *to, const Lane *from, npy_intp rows, npy_intp width, npy_intp column,
                 npy_intp columns, npy_intp first, npy_intp used)
{
    to += first * rows * columns;
    for (npy_intp l = 0; l < used; l++)
        for (npy_intp i = 0; i < rows; i++)
            for (npy_intp j = 0; j < columns; j++)
                *to++ = from[i * width + column + j][l];
}

/* C += factor B for one row of B. */
static inline void add_row(Lane *restrict C, const double *factor, const Lane *restrict B,
                           npy_intp columns)
{
    for (npy_intp j = 0; j < columns; j++)
        EACH C[j][l] += factor[l] * B[j][l];
}

EVERY_WIDTH void lanes_product(Lane *C, npy_intp c, const Lane *A, npy_intp down, npy_intp right,
                               const Lane *B, npy_intp b, npy_intp rows, npy_intp inner,
                               npy_intp columns, How how)
{
    for (npy_intp i = 0; i < rows; i++) {
        if (how == SET)
            lanes_clear(C + i * c, columns);
        for (npy_intp k = 0; k < inner; k++) {
            const double *one = A[i * down + k * right];
            Lane factor;
            if (is_zero(one))
                continue;
            EACH factor[l] = how == SUBTRACT ? -one[l] : one[l];
            add_row(C + i * c, factor, B + k * b, columns);
        }
    }
}

EVERY_WIDTH void lanes_from_left(Lane *C, npy_intp c, const double *M, npy_intp down,
                                 npy_intp right, const Lane *A, npy_intp rows, npy_intp inner,
                                 npy_intp columns)
{
    for (npy_intp i = 0; i < rows; i++) {
        lanes_clear(C + i * c, columns);
        for (npy_intp k = 0; k < inner; k++) {
            const double m = M[i * down + k * right];
            Lane factor;
            if (m == 0.0)
                continue;
            EACH factor[l] = m;
            add_row(C + i * c, factor, A + k * columns, columns);
        }
    }
}

EVERY_WIDTH void lanes_from_right(Lane *C, npy_intp c, const Lane *A, const double *M,
                                  npy_intp rows, npy_intp inner, npy_intp columns)
{
    for (npy_intp i = 0; i < rows; i++)
        lanes_clear(C + i * c, columns);
    for (npy_intp k = 0; k < inner; k++)
        for (npy_intp j = 0; j < columns; j++) {
            const double m = M[k * columns + j];
            for (npy_intp i = 0; m != 0.0 && i < rows; i++)
                EACH C[i * c + j][l] += m * A[i * inner + k][l];
        }
}

/* Exchanges row k with row best[l] in every lane; turns the signs of lanes where they differ. */
static inline void exchange(Lane *A, npy_intp columns, npy_intp k, const double *best, double *sign)
{
    for (int l = 0; l < LANES; l++) {
        const npy_intp other = (npy_intp)best[l];
        if (other == k)
            continue;
        sign[l] = -sign[l];
        for (npy_intp j = 0; j < columns; j++) {
            const double kept = A[k * columns + j][l];
            A[k * columns + j][l] = A[other * columns + j][l];
            A[other * columns + j][l] = kept;
        }
    }
}

EVERY_WIDTH void lanes_solve(Lane *A, Lane *B, npy_intp n, npy_intp columns, double *sign)
{
    Lane unused;
    EACH sign[l] = 1.0;
    for (npy_intp k = 0; k < n; k++) {
        Lane best, most;
        EACH best[l] = (double)k, most[l] = fabs(A[k * n + k][l]);
        for (npy_intp i = k + 1; i < n; i++) {
            const double *a = A[i * n + k];
            EACH
            {
                const double size = fabs(a[l]);
                best[l] = size > most[l] ? (double)i : best[l];
                most[l] = size > most[l] ? size : most[l];
            }
        }
        exchange(A, n, k, best, sign);
        exchange(B, columns, k, best, unused);
        double *pivot = A[k * n + k];
        EACH pivot[l] = 1.0 / pivot[l];
        for (npy_intp i = k + 1; i < n; i++) {
            Lane factor;
            if (is_zero(A[i * n + k]))
                continue;
            EACH factor[l] = -A[i * n + k][l] * pivot[l];
            add_row(A + i * n + k + 1, factor, A + k * n + k + 1, n - k - 1);
            add_row(B + i * columns, factor, B + k * columns, columns);
        }
    }
    for (npy_intp k = n - 1; k >= 0; k--) {
        for (npy_intp i = k + 1; i < n; i++) {
            Lane factor;
            if (is_zero(A[k * n + i]))
                continue;
            EACH factor[l] = -A[k * n + i][l];
            add_row(B + k * columns, factor, B + i * columns, columns);
        }
        for (npy_intp j = 0; j < columns; j++)
            EACH B[k * columns + j][l] *= A[k * n + k][l];
    }
}

EVERY_WIDTH void lanes_qr(Lane *A, Lane *R, Lane *X, npy_intp rows, npy_intp columns)
{
    lanes_clear(R, columns * columns);
    lanes_clear(X, columns * columns);
    for (npy_intp j = 0; j < columns; j++) {
        for (int pass = 0; pass < 2; pass++)
            for (npy_intp k = 0; k < j; k++) {
                Lane along = {0};
                for (npy_intp i = 0; i < rows; i++)
                    EACH along[l] += A[i * columns + k][l] * A[i * columns + j][l];
                if (is_zero(along))
                    continue;
                for (npy_intp i = 0; i < rows; i++)
                    EACH A[i * columns + j][l] -= along[l] * A[i * columns + k][l];
                EACH R[k * columns + j][l] += along[l];
            }
        Lane norm = {0};
        for (npy_intp i = 0; i < rows; i++)
            EACH norm[l] += A[i * columns + j][l] * A[i * columns + j][l];
        EACH norm[l] = sqrt(norm[l]);
        EACH X[j * columns + j][l] = 1.0 / norm[l];
        for (npy_intp i = 0; i < rows; i++)
            EACH A[i * columns + j][l] /= norm[l];
        /* Column j of R⁻¹ = −R⁻¹ (the columns before) R_j / R_jj. */
        for (npy_intp i = 0; i < j; i++) {
            Lane sum = {0};
            for (npy_intp k = i; k < j; k++)
                EACH sum[l] += X[i * columns + k][l] * R[k * columns + j][l];
            EACH X[i * columns + j][l] = -sum[l] / norm[l];
        }
    }
}

EVERY_WIDTH void lanes_norm(double *out, const Lane *A, npy_intp entries)
{
    Lane sum = {0};
    for (npy_intp i = 0; i < entries; i++)
        EACH sum[l] += A[i][l] * A[i][l];
    EACH out[l] = sqrt(sum[l]);
}
