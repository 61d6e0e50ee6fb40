/* gpebo_cli/observers: the matrices of the observer, its signals and its states.

   Matrices at many times are worked on LANES times at once, entry by entry: the innermost loop has
   a length that the compiler knows, and entries that are zero at all these times cost nothing.
   "(N or 1, …)" is an argument that may be constant in time. */
#include "stack.h"

#include <float.h>

#define LANES 8
typedef double Lane[LANES]; /* one entry at LANES times */

/* The entries at the times first, first + 1, …; beyond the end, those at the end. */
static void load(Lane *to, const Stack *from, npy_intp first)
{
    const npy_intp numbers = from->numbers;
    for (int l = 0; l < LANES; l++) {
        const npy_intp at = first + l < from->times ? first + l : from->times - 1;
        const double *one = from->at + at * numbers;
        for (npy_intp i = 0; i < numbers; i++)
            to[i][l] = one[i];
    }
}

/* :func:`load` of what depends on time, or of what does not, for the first block only. */
static void refresh(Lane *to, const Stack *from, npy_intp first)
{
    if (first == 0 || from->times > 1)
        load(to, from, first);
}

/* Writes `columns` of each row of (rows, width) entries from `column` on to (times, rows,
   columns). */
static void store(double *to, npy_intp times, npy_intp first, const Lane *from, npy_intp rows,
                  npy_intp width, npy_intp column, npy_intp columns)
{
    const npy_intp count = times - first < LANES ? times - first : LANES;
    if (columns == width) { /* all of it */
        columns *= rows;
        width *= rows;
        rows = 1;
    }
    for (npy_intp l = 0; l < count; l++) {
        double *one = to + (first + l) * rows * columns;
        for (npy_intp i = 0; i < rows; i++)
            for (npy_intp j = 0; j < columns; j++)
                one[i * columns + j] = from[i * width + column + j][l];
    }
}

static void clear(Lane *out, npy_intp numbers) { memset(out, 0, numbers * sizeof(Lane)); }

static inline int all_zero(const double *restrict a)
{
    double any = 0.0;
    for (int l = 0; l < LANES; l++)
        any += fabs(a[l]); /* a NaN is not zero */
    return any == 0.0;
}

/* C (rows, columns; row length c) += sign A B, with A (rows, inner; row length a) or, if
   `turned`, Aᵀ of A (inner, rows; row length a), and B (inner, columns; row length b). */
EVERY_WIDTH static void lanes_add(Lane *restrict C, npy_intp c, const Lane *restrict A, npy_intp a,
                                  int turned, const Lane *restrict B, npy_intp b, npy_intp rows,
                                  npy_intp inner, npy_intp columns, double sign)
{
    for (npy_intp i = 0; i < rows; i++)
        for (npy_intp k = 0; k < inner; k++) {
            const double *restrict factor = turned ? A[k * a + i] : A[i * a + k];
            if (all_zero(factor))
                continue;
            Lane signed_factor;
            for (int l = 0; l < LANES; l++)
                signed_factor[l] = sign * factor[l];
            for (npy_intp j = 0; j < columns; j++) {
                double *restrict out = C[i * c + j];
                const double *restrict right = B[k * b + j];
                for (int l = 0; l < LANES; l++)
                    out[l] += signed_factor[l] * right[l];
            }
        }
}

/* C (rows, columns; row length c) += A M for a constant M (inner, columns). */
EVERY_WIDTH static void times_constant(Lane *restrict C, npy_intp c, const Lane *restrict A,
                                       const double *restrict M, npy_intp rows, npy_intp inner,
                                       npy_intp columns)
{
    for (npy_intp k = 0; k < inner; k++)
        for (npy_intp j = 0; j < columns; j++) {
            const double m = M[k * columns + j];
            if (m == 0.0)
                continue;
            for (npy_intp i = 0; i < rows; i++) {
                double *restrict out = C[i * c + j];
                const double *restrict left = A[i * inner + k];
                for (int l = 0; l < LANES; l++)
                    out[l] += m * left[l];
            }
        }
}

/* C (rows, columns; row length c) += M A for a constant M (rows, inner), or Mᵀ of M (inner, rows)
   if `turned`, and A (inner, columns). */
EVERY_WIDTH static void constant_times(Lane *restrict C, npy_intp c, const double *restrict M,
                                       int turned, const Lane *restrict A, npy_intp rows,
                                       npy_intp inner, npy_intp columns)
{
    for (npy_intp i = 0; i < rows; i++)
        for (npy_intp k = 0; k < inner; k++) {
            const double m = turned ? M[k * rows + i] : M[i * inner + k];
            if (m == 0.0)
                continue;
            for (npy_intp j = 0; j < columns; j++) {
                double *restrict out = C[i * c + j];
                const double *restrict right = A[k * columns + j];
                for (int l = 0; l < LANES; l++)
                    out[l] += m * right[l];
            }
        }
}

/* The sum of squares of some entries at each of the times. */
EVERY_WIDTH static void squares(double *restrict out, const Lane *restrict A, npy_intp numbers)
{
    for (int l = 0; l < LANES; l++)
        out[l] = 0.0;
    for (npy_intp i = 0; i < numbers; i++)
        for (int l = 0; l < LANES; l++)
            out[l] += A[i][l] * A[i][l];
}

/* Q R = A with orthonormal Q (rows, columns) in the place of A and X = R⁻¹ (columns, columns).

   Gram-Schmidt, twice: Q is orthonormal to rounding unless A is rank-deficient to rounding, which
   a large X shows (or entries that are no numbers, where a column vanishes). */
EVERY_WIDTH static void factorise(Lane *restrict A, Lane *restrict R, Lane *restrict X,
                                  npy_intp rows, npy_intp columns)
{
    clear(R, columns * columns);
    clear(X, columns * columns);
    for (npy_intp j = 0; j < columns; j++) {
        for (int pass = 0; pass < 2; pass++)
            for (npy_intp k = 0; k < j; k++) {
                Lane along = {0};
                for (npy_intp i = 0; i < rows; i++)
                    for (int l = 0; l < LANES; l++)
                        along[l] += A[i * columns + k][l] * A[i * columns + j][l];
                if (all_zero(along))
                    continue;
                for (npy_intp i = 0; i < rows; i++)
                    for (int l = 0; l < LANES; l++)
                        A[i * columns + j][l] -= along[l] * A[i * columns + k][l];
                for (int l = 0; l < LANES; l++)
                    R[k * columns + j][l] += along[l];
            }
        Lane norm = {0};
        for (npy_intp i = 0; i < rows; i++)
            for (int l = 0; l < LANES; l++)
                norm[l] += A[i * columns + j][l] * A[i * columns + j][l];
        for (int l = 0; l < LANES; l++) {
            norm[l] = sqrt(norm[l]);
            X[j * columns + j][l] = 1.0 / norm[l];
        }
        for (npy_intp i = 0; i < rows; i++)
            for (int l = 0; l < LANES; l++)
                A[i * columns + j][l] /= norm[l];
        /* Column j of R⁻¹ = −R⁻¹ (the columns before) R_j / R_jj. */
        for (npy_intp i = 0; i < j; i++) {
            Lane sum = {0};
            for (npy_intp k = i; k < j; k++)
                for (int l = 0; l < LANES; l++)
                    sum[l] += X[i * columns + k][l] * R[k * columns + j][l];
            for (int l = 0; l < LANES; l++)
                X[i * columns + j][l] = -sum[l] / norm[l];
        }
    }
}

/* The largest of numbers so far, which is NaN once one of them was. */
typedef struct {
    Lane most, sum;
} Largest;

static void look_at(Largest *restrict so_far, const Lane *restrict values, npy_intp numbers)
{
    for (npy_intp i = 0; i < numbers; i++) {
        if (all_zero(values[i]))
            continue;
        for (int l = 0; l < LANES; l++) {
            const double size = fabs(values[i][l]);
            so_far->most[l] = size > so_far->most[l] ? size : so_far->most[l];
            so_far->sum[l] += size;
        }
    }
}

static double largest_of(const Largest *so_far)
{
    double most = 0.0;
    for (int l = 0; l < LANES; l++) {
        if (so_far->sum[l] != so_far->sum[l])
            return NAN;
        most = so_far->most[l] > most ? so_far->most[l] : most;
    }
    return most;
}

/* The largest of `numbers` doubles, NaN if one of them is. */
static double largest_in(const double *restrict from, npy_intp numbers)
{
    Largest so_far = {{0}, {0}};
    const npy_intp whole = numbers / LANES;
    look_at(&so_far, (const Lane *)from, whole);
    Lane rest = {0};
    memcpy(rest, from + whole * LANES, (numbers - whole * LANES) * sizeof(double));
    look_at(&so_far, &rest, 1);
    return largest_of(&so_far);
}

/* What `in_frame` works with at LANES times. */
typedef struct {
    Lane *E, *A, *B, *F, *C;          /* (n, n), (n, n), (n, m), (n, q), (r, n) */
    Lane *Q, *R, *X;                  /* of U'E B: (d, d) each */
    Lane *pinv;                       /* (d, n) */
    Lane *algebraic;                  /* (e + r, n) */
    Lane *through;                    /* (e + r, d + q + m + r): A B | G | g_signals */
    Lane *Q1, *R1, *X1, *H;           /* (e + r, b), (b, b), (b, b), (n, b) */
    Lane *Lambda, *whole, *LH, *seen; /* (d, n), (d, d + q + m + r), (d, b), (b, ...) */
    Lane *work;
} Frame;

/* E, A, B, F, C, rows (n,), scale (r,), domain (n, d), range (n, d), kernel (n, b), equations
   (e, n) -> sizes (5,): the largest entry of E outside the frame; if that is not 0, the largest of
   E itself; the largest norm of UᵀE B and of its inverse; the smallest injectivity; then, as
   fields of ObserverMatrices and of its split, pinv, algebraic, on_basis, g_signals, G, range,
   elimination, injectivity, dynamics, from_unknowns, from_signals.

   For e + r >= b; the first five are (N or 1, …). Where UᵀE B or 𝒜 on the kernel is singular, the
   inverse's norm and the injectivity are infinite, zero or no numbers. */
static PyObject *in_frame(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Stack E, A, B, F, C;
    if (!begin(&call, given, count, 11) || !stack(&call, 0, 2, &E) || !stack(&call, 1, 2, &A) ||
        !stack(&call, 2, 2, &B) || !stack(&call, 3, 2, &F) || !stack(&call, 4, 2, &C))
        return failed(&call);
    PyArrayObject *constants[6];
    for (int i = 0; i < 6; i++)
        if ((constants[i] = doubles(&call, 5 + i, i < 2 ? 1 : 2)) == NULL)
            return failed(&call);
    const npy_intp n = size(constants[0], 0), r = size(constants[1], 0);
    const npy_intp d = size(constants[2], 1), b = size(constants[4], 1), e = size(constants[5], 0);
    const npy_intp m = last(&B, 1), q = last(&F, 1), all = e + r, width = d + q + m + r;
    npy_intp N = 1;
    const Stack *each[] = {&E, &A, &B, &F, &C};
    for (int i = 0; i < 5; i++) {
        N = each[i]->times != 1 ? each[i]->times : N;
        if (!same("states of the matrices", i < 4 ? last(each[i], 2) : last(each[i], 1), n))
            return failed(&call);
    }
    for (int i = 0; i < 5; i++)
        if (!lasting("times of the matrices", each[i], N))
            return failed(&call);
    if (!same("columns of E", last(&E, 1), n) || !same("columns of A", last(&A, 1), n) ||
        !same("outputs of C and scale", last(&C, 2), r) ||
        !same("states of the domain", size(constants[2], 0), n) ||
        !same("states of the range", size(constants[3], 0), n) ||
        !same("ranks of domain and range", size(constants[3], 1), d) ||
        !same("states of the kernel", size(constants[4], 0), n) ||
        !same("states of the equations", size(constants[5], 1), n))
        return failed(&call);
    if (all < b) {
        PyErr_SetString(PyExc_ValueError, "fewer rows than the kernel has columns");
        return failed(&call);
    }
    const double *rows = data(constants[0]), *scale = data(constants[1]);
    const double *domain = data(constants[2]), *range = data(constants[3]);
    const double *kernel = data(constants[4]), *equations = data(constants[5]);
    const npy_intp NE = E.times, NA = A.times > C.times ? A.times : C.times;
    const npy_intp NG = B.times > F.times ? B.times : F.times, ND = NE > NA ? NE : NA;

    PyArrayObject *sizes = zeros(&call, 1, (npy_intp[]){5});
    PyArrayObject *pinv = fresh(&call, 3, (npy_intp[]){NE, d, n});
    PyArrayObject *algebraic = fresh(&call, 3, (npy_intp[]){NA, all, n});
    PyArrayObject *on_basis = fresh(&call, 3, (npy_intp[]){NA, all, d});
    PyArrayObject *g_signals = fresh(&call, 3, (npy_intp[]){NG, all, m + r});
    PyArrayObject *G = fresh(&call, 3, (npy_intp[]){NG, all, q});
    PyArrayObject *Q1 = fresh(&call, 3, (npy_intp[]){NA, all, b});
    PyArrayObject *H = fresh(&call, 3, (npy_intp[]){b ? NA : 1, n, b});
    PyArrayObject *injectivity = fresh(&call, 1, (npy_intp[]){NA});
    PyArrayObject *dynamics = fresh(&call, 3, (npy_intp[]){ND, d, d});
    PyArrayObject *unknowns = fresh(&call, 3, (npy_intp[]){N, d, q});
    PyArrayObject *signals = fresh(&call, 3, (npy_intp[]){N, d, m + r});
    const npy_intp lengths[] = {
        n * n, n * n, n * m,     n * q,       r * n,     d * d,           d * d,
        d * d, d * n, all * n,   all * width, all * b,   b * b,           b * b,
        n * b, d * n, d * width, d * b,       b * width, n * (n + e + d),
    };
    npy_intp total = 0;
    for (size_t i = 0; i < sizeof(lengths) / sizeof(lengths[0]); i++)
        total += lengths[i];
    double *memory = signals == NULL ? NULL : old_scratch(&call, total * LANES);
    if (memory == NULL)
        return failed(&call);
    Frame f;
    Lane **places[] = {
        &f.E,       &f.A,  &f.B,  &f.F,  &f.C, &f.Q,      &f.R,     &f.X,  &f.pinv, &f.algebraic,
        &f.through, &f.Q1, &f.R1, &f.X1, &f.H, &f.Lambda, &f.whole, &f.LH, &f.seen, &f.work,
    };
    Lane *next = (Lane *)memory;
    for (size_t i = 0; i < sizeof(lengths) / sizeof(lengths[0]); i++) {
        *places[i] = next;
        next += lengths[i];
    }

    Largest outside = {{0}, {0}}, inner = {{0}, {0}}, inverse = {{0}, {0}};
    for (npy_intp first = 0; first < N; first += LANES) {
        const int new_E = first == 0 || NE > 1, new_A = first == 0 || NA > 1;
        const int new_G = first == 0 || NG > 1, new_D = first == 0 || ND > 1;
        for (int i = 0; i < 4; i++) {
            Lane *to = (Lane *[]){f.E, f.A, f.B, f.F}[i];
            if (first != 0 && each[i]->times == 1)
                continue;
            load(to, each[i], first);
            const npy_intp columns = last(each[i], 1);
            for (npy_intp k = 0; k < n; k++)
                if (rows[k] != 1.0) {
                    const double factor = 1.0 / rows[k]; /* powers of two: no rounding */
                    for (npy_intp j = 0; j < columns; j++)
                        for (int l = 0; l < LANES; l++)
                            to[k * columns + j][l] *= factor;
                }
        }
        if (first == 0 || C.times > 1) {
            load(f.C, &C, first);
            for (npy_intp k = 0; k < r; k++)
                if (scale[k] != 1.0)
                    for (npy_intp j = 0; j < n; j++)
                        for (int l = 0; l < LANES; l++)
                            f.C[k * n + j][l] *= scale[k];
        }
        if (new_E) {
            Lane *beyond = f.work;
            clear(beyond, n * b + e * n);
            times_constant(beyond, b, f.E, kernel, n, n, b);
            constant_times(beyond + n * b, n, equations, 0, f.E, e, n, n);
            look_at(&outside, beyond, n * b + e * n);
            clear(f.work, d * n);
            constant_times(f.work, n, range, 1, f.E, d, n, n);
            clear(f.Q, d * d);
            times_constant(f.Q, d, f.work, domain, d, n, d);
            Lane size_of;
            squares(size_of, f.Q, d * d);
            for (int l = 0; l < LANES; l++)
                size_of[l] = sqrt(size_of[l]);
            look_at(&inner, &size_of, 1);
            factorise(f.Q, f.R, f.X, d, d);
            squares(size_of, f.X, d * d);
            for (int l = 0; l < LANES; l++)
                size_of[l] = sqrt(size_of[l]);
            look_at(&inverse, &size_of, 1);
            /* E⁺ = R⁻¹Qᵀ Uᵀ */
            clear(f.work, d * n);
            for (npy_intp i = 0; i < n; i++)
                for (npy_intp k = 0; k < d; k++) {
                    const double u = range[i * d + k];
                    if (u == 0.0)
                        continue;
                    for (npy_intp j = 0; j < d; j++)
                        for (int l = 0; l < LANES; l++)
                            f.work[j * n + i][l] += u * f.Q[k * d + j][l];
                }
            clear(f.pinv, d * n);
            lanes_add(f.pinv, n, f.X, d, 0, f.work, n, d, d, n, 1.0);
            store(data(pinv), NE, first, f.pinv, d, n, 0, n);
        }
        if (new_A) {
            clear(f.algebraic, e * n);
            constant_times(f.algebraic, n, equations, 0, f.A, e, n, n);
            memcpy(f.algebraic + e * n, f.C, r * n * sizeof(Lane));
            store(data(algebraic), NA, first, f.algebraic, all, n, 0, n);
            for (npy_intp i = 0; i < all; i++)
                clear(f.through + i * width, d);
            times_constant(f.through, width, f.algebraic, domain, all, n, d);
            store(data(on_basis), NA, first, f.through, all, width, 0, d);
            clear(f.Q1, all * b);
            times_constant(f.Q1, b, f.algebraic, kernel, all, n, b);
            factorise(f.Q1, f.R1, f.X1, all, b);
            store(data(Q1), NA, first, f.Q1, all, b, 0, b);
            clear(f.H, n * b);
            constant_times(f.H, b, kernel, 0, f.X1, n, b, b);
            if (b)
                store(data(H), NA, first, f.H, n, b, 0, b);
            Lane norm, bound;
            squares(norm, f.algebraic, all * n);
            squares(bound, f.X1, b * b);
            for (int l = 0; l < LANES; l++) {
                const double size_of = sqrt(norm[l]) > DBL_MIN ? sqrt(norm[l]) : DBL_MIN;
                bound[l] = b ? 1.0 / (sqrt(bound[l]) * size_of) : INFINITY;
            }
            store(data(injectivity), NA, first, &bound, 1, 1, 0, 1);
        }
        if (new_G) {
            for (npy_intp i = 0; i < all; i++)
                clear(f.through + i * width + d, q + m + r);
            constant_times(f.through + d, width, equations, 0, f.F, e, n, q);
            constant_times(f.through + d + q, width, equations, 0, f.B, e, n, m);
            for (npy_intp i = 0; i < r; i++)
                for (int l = 0; l < LANES; l++)
                    f.through[(e + i) * width + d + q + m + i][l] = -scale[i];
            store(data(G), NG, first, f.through, all, width, d, q);
            store(data(g_signals), NG, first, f.through, all, width, d + q, m + r);
        }
        if (first == 0 || NE > 1 || A.times > 1) {
            clear(f.Lambda, d * n);
            lanes_add(f.Lambda, n, f.pinv, n, 0, f.A, n, d, n, n, 1.0);
        }
        if (new_D) {
            clear(f.LH, d * b);
            lanes_add(f.LH, b, f.Lambda, n, 0, f.H, b, d, n, b, 1.0);
        }
        /* [A_0 | D_0 | of u and y] = [Λ B | E⁺F | E⁺B, 0] − Λ H Q1ᵀ [𝒜 B | G | g_signals] */
        clear(f.whole, d * width);
        times_constant(f.whole, width, f.Lambda, domain, d, n, d);
        lanes_add(f.whole + d, width, f.pinv, n, 0, f.F, q, d, n, q, 1.0);
        lanes_add(f.whole + d + q, width, f.pinv, n, 0, f.B, m, d, n, m, 1.0);
        clear(f.seen, b * width);
        lanes_add(f.seen, width, f.Q1, b, 1, f.through, width, b, all, width, 1.0);
        lanes_add(f.whole, width, f.LH, b, 0, f.seen, width, d, b, width, -1.0);
        if (new_D)
            store(data(dynamics), ND, first, f.whole, d, width, 0, d);
        store(data(unknowns), N, first, f.whole, d, width, d, q);
        store(data(signals), N, first, f.whole, d, width, d + q, m + r);
    }
    data(sizes)[0] = largest_of(&outside);
    if (data(sizes)[0] != 0.0)
        for (npy_intp k = 0; k < NE * n; k++) {
            const double most = largest_in(E.at + k * n, n) / rows[k % n];
            data(sizes)[1] = most > data(sizes)[1] ? most : data(sizes)[1];
        }
    data(sizes)[2] = largest_of(&inner);
    data(sizes)[3] = largest_of(&inverse);
    double lowest = INFINITY;
    for (npy_intp k = 0; k < NA; k++) {
        const double one = data(injectivity)[k];
        lowest = one < lowest || one != one ? one : lowest; /* NaN stays: it is below nothing */
        if (one != one)
            break;
    }
    data(sizes)[4] = lowest;
    return results(&call, 12, sizes, pinv, algebraic, on_basis, g_signals, G, Q1, H, injectivity,
                   dynamics, unknowns, signals);
}

/* z (N, k, 1 + p), q, basis (n, k), 𝒜B (N or 1, rows, k), g_y (N, rows), G (N or 1, rows, q),
   Q1 (N or 1, rows, b), H (N or 1, n, b) -> Y (N, rows), psi (N, rows, p), offset (N, n), gain
   (N, n, p), sizes (1 + p,) of the terms of Y and of the columns of psi before they cancel. */
static PyObject *regression_signals(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Stack z, A, g, G, Q1, H;
    npy_intp q;
    PyArrayObject *basis;
    if (!begin(&call, given, count, 8) || !stack(&call, 0, 2, &z) || !count_of(&call, 1, &q) ||
        (basis = doubles(&call, 2, 2)) == NULL || !stack(&call, 3, 2, &A) ||
        !stack(&call, 4, 1, &g) || !stack(&call, 5, 2, &G) || !stack(&call, 6, 2, &Q1) ||
        !stack(&call, 7, 2, &H))
        return failed(&call);
    const npy_intp N = z.times, k = last(&z, 2), columns = last(&z, 1), p = columns - 1;
    const npy_intp rows = last(&A, 2), b = last(&Q1, 1), n = size(basis, 0);
    if (!same("coordinates of z and basis", k, size(basis, 1)) ||
        !same("coordinates of z and A", k, last(&A, 1)) ||
        !same("rows of g_y", last(&g, 1), rows) || !same("rows of G", last(&G, 2), rows) ||
        !same("unknowns of G", last(&G, 1), q) || !same("rows of Q1", last(&Q1, 2), rows) ||
        !same("states of H", last(&H, 2), n) || !same("columns of H and Q1", last(&H, 1), b) ||
        !lasting("times of A", &A, N) || !lasting("times of g_y", &g, N) ||
        !lasting("times of G", &G, N) || !lasting("times of Q1", &Q1, N) ||
        !lasting("times of H", &H, N))
        return failed(&call);
    if (p < q) {
        PyErr_SetString(PyExc_ValueError, "fewer columns than unknowns");
        return failed(&call);
    }
    PyArrayObject *Y = fresh(&call, 2, (npy_intp[]){N, rows});
    PyArrayObject *psi = fresh(&call, 3, (npy_intp[]){N, rows, p});
    PyArrayObject *offset = fresh(&call, 2, (npy_intp[]){N, n});
    PyArrayObject *gain = fresh(&call, 3, (npy_intp[]){N, n, p});
    PyArrayObject *sizes = zeros(&call, 1, (npy_intp[]){columns});
    const npy_intp total = z.numbers + A.numbers + g.numbers + G.numbers + Q1.numbers + H.numbers +
                           (rows + b + n + 1) * columns;
    double *memory = sizes == NULL ? NULL : old_scratch(&call, total * LANES);
    if (memory == NULL)
        return failed(&call);
    Lane *signed_z = (Lane *)memory, *left = signed_z + z.numbers, *known = left + A.numbers;
    Lane *of_theta = known + g.numbers, *range = of_theta + G.numbers;
    Lane *elimination = range + Q1.numbers, *terms = elimination + H.numbers;
    Lane *seen = terms + rows * columns, *state = seen + b * columns;
    Lane *most = state + n * columns;
    Largest in_Y = {{0}, {0}};
    clear(most, columns);
    for (npy_intp first = 0; first < N; first += LANES) {
        load(signed_z, &z, first);
        for (npy_intp i = 0; i < k; i++) /* w = ξ_a + ξ_b θ − Φ e₀ and ψ has −ξ_b, +Φ */
            for (npy_intp j = 1; j < 1 + q; j++)
                for (int l = 0; l < LANES; l++)
                    signed_z[i * columns + j][l] = -signed_z[i * columns + j][l];
        refresh(left, &A, first);
        refresh(known, &g, first);
        refresh(of_theta, &G, first);
        refresh(range, &Q1, first);
        refresh(elimination, &H, first);
        clear(terms, rows * columns);
        lanes_add(terms, columns, left, k, 0, signed_z, columns, rows, k, columns, 1.0);
        for (npy_intp i = 0; i < rows; i++) {
            Lane *row = terms + i * columns;
            look_at(&in_Y, row, 1);
            look_at(&in_Y, known + i, 1);
            for (int l = 0; l < LANES; l++)
                row[0][l] += known[i][l];
            for (npy_intp j = 0; j < q; j++)
                for (int l = 0; l < LANES; l++)
                    row[1 + j][l] -= of_theta[i * q + j][l];
            for (npy_intp j = 1; j < columns; j++)
                for (int l = 0; l < LANES; l++)
                    most[j][l] = larger(most[j][l], fabs(row[j][l]));
        }
        clear(seen, b * columns);
        lanes_add(seen, columns, range, b, 1, terms, columns, b, rows, columns, 1.0);
        lanes_add(terms, columns, range, b, 0, seen, columns, rows, b, columns, -1.0);
        clear(state, n * columns);
        constant_times(state, columns, data(basis), 0, signed_z, n, k, columns);
        lanes_add(state, columns, elimination, b, 0, seen, columns, n, b, columns, -1.0);
        for (npy_intp i = 0; i < n; i++)
            for (npy_intp j = 1; j < columns; j++)
                for (int l = 0; l < LANES; l++)
                    state[i * columns + j][l] = -state[i * columns + j][l];
        store(data(Y), N, first, terms, rows, columns, 0, 1);
        store(data(psi), N, first, terms, rows, columns, 1, p);
        store(data(offset), N, first, state, n, columns, 0, 1);
        store(data(gain), N, first, state, n, columns, 1, p);
    }
    data(sizes)[0] = largest_of(&in_Y);
    for (npy_intp j = 1; j < columns; j++)
        for (int l = 0; l < LANES; l++)
            data(sizes)[j] = larger(data(sizes)[j], most[j][l]);
    return results(&call, 5, Y, psi, offset, gain, sizes);
}

/* At N times, ψᵀψ (p, p) to `square` and ψᵀY (p, c) to `right`, whose rows are a and b apart and
   whose matrices follow upon p rows. */
static void add_products(double *square, npy_intp a, double *right, npy_intp b, const double *psi,
                         const double *Y, npy_intp N, npy_intp rows, npy_intp p, npy_intp c)
{
    for (npy_intp t = 0; t < N;
         t++, square += p * a, right += p * b, psi += rows * p, Y += rows * c)
        for (npy_intp i = 0; i < p; i++) {
            double *restrict one = square + i * a, *restrict other = right + i * b;
            for (npy_intp j = 0; j < i; j++)
                one[j] = square[j * a + i];
            for (npy_intp j = i; j < p; j++) {
                double sum = 0.0;
                for (npy_intp k = 0; k < rows; k++)
                    sum += psi[k * p + i] * psi[k * p + j];
                one[j] = sum;
            }
            for (npy_intp j = 0; j < c; j++)
                other[j] = 0.0;
            for (npy_intp k = 0; k < rows; k++) {
                const double factor = psi[k * p + i];
                const double *restrict row = Y + k * c;
                for (npy_intp j = 0; j < c; j++)
                    other[j] += factor * row[j];
            }
        }
}

/* psi (K, s + 1, rows, p), Y (K, s + 1, rows, c) -> [ψᵀψ | ψᵀY] (K, s + 1, p, p + c). */
static PyObject *outer_products(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 2))
        return NULL;
    PyArrayObject *psi = doubles(&call, 0, 4), *Y = psi == NULL ? NULL : doubles(&call, 1, 4);
    if (Y == NULL || !same("elements of psi and Y", size(psi, 0), size(Y, 0)) ||
        !same("points of psi and Y", size(psi, 1), size(Y, 1)) ||
        !same("rows of psi and Y", size(psi, 2), size(Y, 2)))
        return failed(&call);
    const npy_intp N = size(psi, 0) * size(psi, 1), p = size(psi, 3), c = size(Y, 3);
    PyArrayObject *out = fresh(&call, 4, (npy_intp[]){size(psi, 0), size(psi, 1), p, p + c});
    if (out == NULL)
        return failed(&call);
    add_products(data(out), p + c, data(out) + p, p + c, data(psi), data(Y), N, size(psi, 2), p, c);
    return results(&call, 1, out);
}

PyMethodDef observer_kernels[] = {
    KERNEL(in_frame), KERNEL(regression_signals), KERNEL(outer_products), {NULL, NULL, 0, NULL},
};
