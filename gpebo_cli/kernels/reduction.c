/* gpebo_cli/simulation: bounds of ranks, and the strangeness-free system, at many times. */
#include "structure.h"

#include <float.h>

/* Times that are worked on side by side: what is one number for one time is LANES numbers in a
   row, so that loops over small matrices are paid for once and vectorised. */
#define LANES 8
#define MULTIPLIER 4.0 /* of an elimination on shared pivots; beyond it a time gets its own */

#define EACH for (int l = 0; l < LANES; l++)

static inline int nothing(const double *x)
{
    double sum = 0.0;
    EACH sum += fabs(x[l]);
    return sum == 0.0;
}

/* Solves A X = B in every lane, A (n, n, LANES), B (n, columns, LANES) becoming X. Rows are
   exchanged for all lanes alike, the largest in sum first; a lane for which that leads to
   multipliers above MULTIPLIER is solved by itself with pivots of its own, and is NaN if
   singular. memory: (n + columns) n (LANES + 1) numbers. */
EVERY_WIDTH static void solve_lanes(double *restrict A, double *restrict B, npy_intp n,
                                    npy_intp columns, double *restrict memory)
{
    double *kept_A = memory, *kept_B = memory + n * n * LANES;
    memcpy(kept_A, A, n * n * LANES * sizeof(double));
    memcpy(kept_B, B, n * columns * LANES * sizeof(double));
    double good[LANES];
    EACH good[l] = 1.0;
    for (npy_intp k = 0; k < n; k++) {
        npy_intp best = k;
        double most = -1.0;
        for (npy_intp i = k; i < n; i++) {
            const double *a = A + (i * n + k) * LANES;
            double sum = 0.0;
            EACH sum += fabs(a[l]);
            if (sum > most)
                most = sum, best = i;
        }
        if (best != k) {
            double *x = A + (k * n + k) * LANES, *y = A + (best * n + k) * LANES;
            for (npy_intp j = 0; j < (n - k) * LANES; j++) {
                const double kept = x[j];
                x[j] = y[j];
                y[j] = kept;
            }
            x = B + k * columns * LANES, y = B + best * columns * LANES;
            for (npy_intp j = 0; j < columns * LANES; j++) {
                const double kept = x[j];
                x[j] = y[j];
                y[j] = kept;
            }
        }
        double *pivot = A + (k * n + k) * LANES;
        EACH
        {
            good[l] = fabs(pivot[l]) > 0.0 ? good[l] : 0.0;
            pivot[l] = 1.0 / pivot[l];
        }
        const double *known = B + k * columns * LANES;
        for (npy_intp i = k + 1; i < n; i++) {
            double *row = A + (i * n + k) * LANES, *right = B + i * columns * LANES;
            if (nothing(row))
                continue;
            double factor[LANES];
            EACH
            {
                factor[l] = row[l] * pivot[l];
                good[l] = fabs(factor[l]) <= MULTIPLIER ? good[l] : 0.0;
            }
            for (npy_intp j = 1; j < n - k; j++)
                EACH row[j * LANES + l] -= factor[l] * pivot[j * LANES + l];
            for (npy_intp j = 0; j < columns; j++)
                EACH right[j * LANES + l] -= factor[l] * known[j * LANES + l];
        }
    }
    for (npy_intp k = n - 1; k >= 0; k--) {
        double *solved = B + k * columns * LANES;
        for (npy_intp i = k + 1; i < n; i++) {
            const double *a = A + (k * n + i) * LANES, *later = B + i * columns * LANES;
            if (nothing(a))
                continue;
            for (npy_intp j = 0; j < columns; j++)
                EACH solved[j * LANES + l] -= a[l] * later[j * LANES + l];
        }
        const double *pivot = A + (k * n + k) * LANES;
        for (npy_intp j = 0; j < columns; j++)
            EACH solved[j * LANES + l] *= pivot[l];
    }
    double *one = kept_B + n * columns * LANES, *right = one + n * n;
    for (int l = 0; l < LANES; l++) {
        if (good[l] != 0.0)
            continue;
        for (npy_intp i = 0; i < n * n; i++)
            one[i] = kept_A[i * LANES + l];
        for (npy_intp i = 0; i < n * columns; i++)
            right[i] = kept_B[i * LANES + l];
        const int solved = solve_in_place(one, right, n, columns);
        for (npy_intp i = 0; i < n * columns; i++)
            B[i * LANES + l] = solved ? right[i] : (double)NAN;
    }
}

/* C = A B, or C −= A B, in every lane, A (rows, inner, LANES), B (inner, columns, LANES). */
EVERY_WIDTH static void multiply_lanes(double *restrict C, const double *restrict A,
                                       const double *restrict B, npy_intp rows, npy_intp inner,
                                       npy_intp columns, int subtract)
{
    if (!subtract)
        memset(C, 0, rows * columns * LANES * sizeof(double));
    for (npy_intp i = 0; i < rows; i++, C += columns * LANES)
        for (npy_intp k = 0; k < inner; k++) {
            const double *a = A + (i * inner + k) * LANES, *b = B + k * columns * LANES;
            if (nothing(a))
                continue;
            double factor[LANES];
            EACH factor[l] = subtract ? -a[l] : a[l];
            for (npy_intp j = 0; j < columns; j++)
                EACH C[j * LANES + l] += factor[l] * b[j * LANES + l];
        }
}

/* C = Aᵀ B with A (inner, rows) the same for all lanes, B (inner, columns, LANES). */
EVERY_WIDTH static void multiply_same(double *restrict C, const double *restrict A,
                                      const double *restrict B, npy_intp rows, npy_intp inner,
                                      npy_intp columns)
{
    memset(C, 0, rows * columns * LANES * sizeof(double));
    for (npy_intp i = 0; i < rows; i++, C += columns * LANES)
        for (npy_intp k = 0; k < inner; k++) {
            const double a = A[k * rows + i];
            const double *b = B + k * columns * LANES;
            if (a != 0.0)
                for (npy_intp j = 0; j < columns * LANES; j++)
                    C[j] += a * b[j];
        }
}

/* Frobenius norms of every lane of x (count, LANES), at least the smallest positive number. */
EVERY_WIDTH static void norms(const double *x, npy_intp count, double *out)
{
    double sum[LANES] = {0};
    for (npy_intp i = 0; i < count; i++)
        EACH sum[l] += x[i * LANES + l] * x[i * LANES + l];
    EACH out[l] = sqrt(sum[l]) + DBL_MIN;
}

/* The first `orders` coefficients at times first … first + used − 1 into out (orders, entries,
   LANES); lanes that are left repeat the last time. What is constant has to come in once. */
static void gather(double *out, const Series *from, npy_intp orders, npy_intp first, npy_intp used)
{
    if (from->time == 0 && first > 0)
        return;
    for (npy_intp k = 0; k < orders; k++, out += from->entries * LANES)
        for (npy_intp l = 0; l < LANES; l++) {
            const npy_intp t = first + (l < used ? l : used - 1);
            const double *at = from->at + k * from->order + t * from->time;
            for (npy_intp i = 0; i < from->entries; i++)
                out[i * LANES + l] = at[i];
        }
}

/* Elimination on the pivots of one time at all others. */
typedef struct {
    const npy_intp *rows, *columns; /* (size,) of M, the pivots first */
    npy_intp rank, a, d;
    const double *Z1;                  /* (n, d) */
    npy_intp *block, *within;          /* (2 size,) where rows and columns stand: block, entry */
    double *raw_e, *raw_a;             /* (mu + 1, n, n, LANES) as they came */
    double *e, *a_;                    /* likewise, scaled */
    double *M11, *M12, *M21, *M22, *X; /* blocks of M[rows, columns], and of its elimination */
    double *N1, *N2;                   /* (rank, n), (a, n): N[rows], N2 becoming Â2 */
    double *whole, *inverse;           /* (n, n) */
    double *scale, *memory;            /* (n,) of the rows of whole */
    double of_M[LANES], of_N[LANES], of_X[LANES], residual[LANES], largest[LANES];
} Elimination;

/* Arguments place … place + 3: rows, columns (size,), rank, Z1 (n, d). */
static int elimination(Call *call, Py_ssize_t place, const Model *m, Elimination *el)
{
    PyArrayObject *rows = indices(call, place, 1);
    PyArrayObject *columns = rows ? indices(call, place + 1, 1) : NULL;
    PyArrayObject *Z1 = columns ? doubles(call, place + 3, 2) : NULL;
    if (Z1 == NULL || !whole_number(call, place + 2, &el->rank))
        return 0;
    const npy_intp n = m->n, size = m->size, r = el->rank;
    el->a = size - r;
    el->d = n - el->a;
    if (r < 0 || el->a < 0 || el->d < 0) {
        PyErr_SetString(PyExc_ValueError, "a rank that does not fit");
        return 0;
    }
    if (!same("rows of M", PyArray_DIM(rows, 0), size) ||
        !same("columns of M", PyArray_DIM(columns, 0), size) ||
        !same("rows of Z1", PyArray_DIM(Z1, 0), n) ||
        !same("columns of Z1", PyArray_DIM(Z1, 1), el->d))
        return 0;
    el->rows = (const npy_intp *)PyArray_DATA(rows);
    el->columns = (const npy_intp *)PyArray_DATA(columns);
    el->Z1 = data(Z1);
    PyArrayObject *where = fresh_indices(call, 4 * size);
    const npy_intp a = el->a, widest = r > n ? r : n;
    double *memory = where ? old_scratch(call, LANES * (4 * n * size + size * size + 2 * a * r +
                                                    size * n + 2 * n * n + n) +
                                               2 * widest * widest * (LANES + 1))
                           : NULL;
    if (memory == NULL)
        return 0;
    el->block = (npy_intp *)PyArray_DATA(where);
    el->within = el->block + 2 * size;
    for (npy_intp i = 0; i < 2 * size; i++) {
        const npy_intp at = i < size ? el->rows[i] : el->columns[i - size];
        if (at < 0 || at >= size) {
            PyErr_SetString(PyExc_ValueError, "rows or columns that M does not have");
            return 0;
        }
        el->block[i] = at / n;
        el->within[i] = at % n;
    }
    double **parts[] = {&el->raw_e, &el->raw_a, &el->e,       &el->a_,   &el->M11,
                        &el->M12,   &el->M21,   &el->M22,     &el->X,    &el->N1,
                        &el->N2,    &el->whole, &el->inverse, &el->scale};
    const npy_intp sizes[] = {n * size, n * size, n * size, n * size, r * r, r * a, a * r,
                              a * a,    a * r,    r * n,    a * n,    n * n, n * n, n};
    for (size_t i = 0; i < sizeof(sizes) / sizeof(sizes[0]); i++) {
        *parts[i] = memory;
        memory += sizes[i] * LANES;
    }
    el->memory = memory;
    return 1;
}

/* Rows `from` … `to` − 1, columns `left` … `right` − 1 of M[rows, columns] into out, by rows or
   transposed. */
static void block_of(const Model *m, const Elimination *el, npy_intp from, npy_intp to,
                     npy_intp left, npy_intp right, int transposed, double *out)
{
    const npy_intp n = m->n, size = m->size;
    for (npy_intp p = from; p < to; p++)
        for (npy_intp q = left; q < right; q++) {
            const npy_intp i = el->block[p], j = el->block[size + q];
            const npy_intp entry = el->within[p] * n + el->within[size + q];
            double *at = out + (transposed ? (q - left) * (to - from) + p - from
                                           : (p - from) * (right - left) + q - left) *
                                   LANES;
            if (j > i) {
                memset(at, 0, LANES * sizeof(double));
                continue;
            }
            const double *e = el->e + ((i - j) * n * n + entry) * LANES, factor = (double)(j + 1);
            if (j == i) {
                EACH at[l] = factor * e[l];
            } else {
                const double *a = el->a_ + ((i - j - 1) * n * n + entry) * LANES;
                EACH at[l] = factor * e[l] - a[l];
            }
        }
}

/* Scaled coefficients and the blocks of M and N at one block of times; M11 and M21 may be wanted
   transposed. */
EVERY_WIDTH static void fill(const Model *m, Elimination *el, npy_intp first, npy_intp used,
                             int transposed)
{
    const npy_intp n = m->n, size = m->size, r = el->rank;
    gather(el->raw_e, &m->E, m->mu + 1, first, used);
    gather(el->raw_a, &m->A, m->mu + 1, first, used);
    double power = 1.0;
    for (npy_intp k = 0; k <= m->mu; k++, power *= m->time)
        for (npy_intp i = 0; i < n * n; i++) {
            const double weight = m->rows[i / n] * m->columns[i % n];
            const npy_intp at = (k * n * n + i) * LANES;
            if (first == 0 || m->E.time)
                EACH el->e[at + l] = el->raw_e[at + l] * weight * power / m->time;
            if (first == 0 || m->A.time)
                EACH el->a_[at + l] = el->raw_a[at + l] * weight * power;
        }
    block_of(m, el, 0, r, 0, r, transposed, el->M11);
    block_of(m, el, 0, r, r, size, 0, el->M12);
    block_of(m, el, r, size, 0, r, transposed, el->M21);
    block_of(m, el, r, size, r, size, 0, el->M22);
    norms(el->M11, size * size, el->of_M); /* the four lie one behind the other */
    if (first == 0 || m->A.time) {
        norms(el->a_, n * size, el->of_N);
        EACH el->largest[l] = 0.0;
        for (npy_intp i = 0; i < n * size; i++)
            EACH
            {
                const double x = fabs(el->a_[i * LANES + l]);
                el->largest[l] = x > el->largest[l] ? x : el->largest[l];
            }
    }
    for (npy_intp p = 0; p < size; p++)
        memcpy((p < r ? el->N1 + p * n * LANES : el->N2 + (p - r) * n * LANES),
               el->a_ + (el->block[p] * n + el->within[p]) * n * LANES, n * LANES * sizeof(double));
}

/* With X in place: the residual M22 − X M12 and Â2 = N2 − X N1, [Z1ᵀE; Â2] into whole. */
static void eliminate(const Model *m, Elimination *el)
{
    const npy_intp n = m->n, r = el->rank, a = el->a;
    multiply_lanes(el->M22, el->X, el->M12, a, r, a, 1);
    norms(el->M22, a * a, el->residual);
    norms(el->X, a * r, el->of_X);
    multiply_lanes(el->N2, el->X, el->N1, a, r, n, 1);
    multiply_same(el->whole, el->Z1, el->e, el->d, n, n);
    memcpy(el->whole + el->d * n * LANES, el->N2, a * n * LANES * sizeof(double));
}

static void identity(double *out, npy_intp n)
{
    memset(out, 0, n * n * LANES * sizeof(double));
    for (npy_intp i = 0; i < n; i++)
        EACH out[(i * n + i) * LANES + l] = 1.0;
}

/* all_levels(E, A, rows, columns, time, mu, pivot rows, pivot columns, rank, Z1, rank_tol,
   plain, residual) -> known (3,), smallest (N, 3), dynamics (N, d, d).

   smallest holds bounds of the singular values, and these themselves where a bound is at most
   `plain`, where the elimination leaves more than `residual`, where a bound is smallest, and in
   the middle; known is whether all went well, the least of those computed, and whether the
   dynamics Z1ᵀA T are finite. Otherwise LAPACK has to look, and the rest means nothing. */
static PyObject *all_levels(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Model m;
    Look look;
    Elimination el;
    double rank_tol, plain, most_left;
    if (!begin(&call, given, count, 13))
        return NULL;
    if (!model(&call, &m) || !elimination(&call, 6, &m, &el) || !prepare(&call, &m, &look) ||
        !number(&call, 10, &rank_tol) || !number(&call, 11, &plain) ||
        !number(&call, 12, &most_left))
        return failed(&call);
    const npy_intp n = m.n, r = el.rank, a = el.a, d = el.d, times = m.times;
    PyArrayObject *known = zeros(&call, 1, (npy_intp[]){3});
    PyArrayObject *smallest = known ? fresh(&call, 2, (npy_intp[]){times, 3}) : NULL;
    PyArrayObject *dynamics = smallest ? fresh(&call, 3, (npy_intp[]){times, d, d}) : NULL;
    int *closer = dynamics ? integers(&call, times) : NULL;
    double *inverse = closer ? old_scratch(&call, LANES * (r * r + 2 * n * n)) : NULL;
    if (inverse == NULL)
        return failed(&call);
    double *AT = inverse + r * r * LANES, *of_z = AT + n * n * LANES;
    double *bounds = data(smallest), finite = 1.0;
    for (npy_intp first = 0; first < times; first += LANES) {
        const npy_intp used = times - first < LANES ? times - first : LANES;
        fill(&m, &el, first, used, 0);
        identity(inverse, r);
        solve_lanes(el.M11, inverse, r, r, el.memory);
        multiply_lanes(el.X, el.M21, inverse, a, r, r, 0);
        eliminate(&m, &el);
        identity(el.inverse, n);
        solve_lanes(el.whole, el.inverse, n, n, el.memory);
        double of_inverse[LANES], determined[LANES], of_E[LANES];
        norms(inverse, r * r, of_inverse);
        norms(el.inverse, n * n, determined);
        norms(el.e, n * n, of_E);
        /* Z1ᵀ A T, T being the first columns of the inverse. */
        double *T = el.whole;
        for (npy_intp i = 0; i < n; i++)
            memcpy(T + i * d * LANES, el.inverse + i * n * LANES, d * LANES * sizeof(double));
        multiply_lanes(AT, el.a_, T, n, n, d, 0);
        multiply_same(of_z, el.Z1, AT, d, n, d);
        for (npy_intp l = 0; l < used; l++) {
            double *bound = bounds + 3 * (first + l), *z = data(dynamics) + (first + l) * d * d;
            double scale = el.of_M[l] > el.largest[l] ? el.of_M[l] : el.largest[l];
            scale = scale > DBL_MIN ? scale : DBL_MIN;
            bound[0] = r ? 1.0 / (of_inverse[l] * scale) : HUGE_VAL;
            bound[1] =
                a ? 1.0 / (determined[l] * sqrt((double)a + el.of_X[l] * el.of_X[l]) * el.of_N[l])
                  : HUGE_VAL;
            bound[2] = d ? 1.0 / (determined[l] * of_E[l]) : HUGE_VAL;
            closer[first + l] = !(bound[0] > plain && bound[1] > plain && bound[2] > plain &&
                                  el.residual[l] <= most_left * scale);
            if (!(determined[l] < DBL_MAX && of_inverse[l] < DBL_MAX))
                return results(&call, 3, known, smallest, dynamics);
            for (npy_intp i = 0; i < d * d; i++) {
                z[i] = of_z[i * LANES + l];
                finite = fabs(z[i]) < HUGE_VAL ? finite : 0.0;
            }
        }
    }
    for (npy_intp column = 0; column < 3; column++) {
        npy_intp least = 0;
        for (npy_intp t = 1; t < times; t++)
            if (bounds[3 * t + column] < bounds[3 * least + column])
                least = t;
        closer[least] = 1;
    }
    closer[times / 2] = 1;
    double least = HUGE_VAL;
    for (npy_intp t = 0; t < times; t++) {
        if (!closer[t])
            continue;
        if (!look_at(&m, t, -1, rank_tol, 3, &look) || look.constraints != a)
            return results(&call, 3, known, smallest, dynamics);
        for (npy_intp column = 0; column < 3; column++) {
            bounds[3 * t + column] = look.smallest[column];
            least = look.smallest[column] < least ? look.smallest[column] : least;
            if (column && !(look.smallest[column] > rank_tol))
                return results(&call, 3, known, smallest, dynamics);
        }
    }
    data(known)[0] = 1.0;
    data(known)[1] = least;
    data(known)[2] = finite;
    return results(&call, 3, known, smallest, dynamics);
}

/* B, F, u and theta, for f = B u + F theta. */
typedef struct {
    Series B, F, u, theta;
    npy_intp inputs, unknowns, times;
    double *of_B, *of_F, *of_u, *of_theta; /* LANES times of each */
    double *f;                             /* (mu + 1, n, LANES) scaled: g */
} Forcing;

/* Arguments 6 to 9: B (K + 1, N or 1, n, inputs), F (…, n, unknowns), u (…, inputs), theta. */
static int forcing(Call *call, const Model *m, Forcing *f)
{
    if (!series(call, 6, 4, &f->B) || !series(call, 7, 4, &f->F) || !series(call, 8, 3, &f->u) ||
        !series(call, 9, 3, &f->theta))
        return 0;
    PyArrayObject *B = (PyArrayObject *)call->given[6], *F = (PyArrayObject *)call->given[7];
    f->inputs = f->u.entries;
    f->unknowns = f->theta.entries;
    if (!same("rows of B", size(B, 2), m->n) || !same("rows of F", size(F, 2), m->n) ||
        !same("columns of B", size(B, 3), f->inputs) ||
        !same("columns of F", size(F, 3), f->unknowns))
        return 0;
    f->times = m->times;
    const Series *all[] = {&f->B, &f->F, &f->u, &f->theta};
    for (int i = 0; i < 4; i++) {
        f->times = all[i]->times > f->times ? all[i]->times : f->times;
        if (all[i]->orders <= m->mu) {
            PyErr_SetString(PyExc_ValueError, "fewer Taylor coefficients than mu + 1");
            return 0;
        }
    }
    for (int i = 0; i < 4; i++)
        if (all[i]->times != f->times && !same("times of inputs", all[i]->times, 1))
            return 0;
    const npy_intp n = m->n, width = f->inputs + f->unknowns;
    double *memory = old_scratch(call, LANES * (m->mu + 1) * (n * width + width + n));
    if (memory == NULL)
        return 0;
    f->of_B = memory;
    f->of_F = f->of_B + LANES * (m->mu + 1) * n * f->inputs;
    f->of_u = f->of_F + LANES * (m->mu + 1) * n * f->unknowns;
    f->of_theta = f->of_u + LANES * (m->mu + 1) * f->inputs;
    f->f = f->of_theta + LANES * (m->mu + 1) * f->unknowns;
    return 1;
}

/* f_k += Σ_i matrix_i vector_{k−i}, (mu + 1, n, LANES); a constant matrix is read where it is. */
EVERY_WIDTH static void add_product(const Model *m, double *f, const Series *matrix,
                                    const double *lanes, const double *vector, npy_intp width)
{
    const npy_intp n = m->n;
    for (npy_intp i = 0; i <= m->mu; i++)
        for (npy_intp p = 0; p < n * width; p++) {
            const double *a = lanes + (i * n * width + p) * LANES;
            const double once = matrix->at[matrix->time ? 0 : i * matrix->order + p];
            if (matrix->time ? nothing(a) : once == 0.0)
                continue;
            double *to = f + (i * n + p / width) * LANES;
            const double *x = vector + p % width * LANES;
            for (npy_intp k = i; k <= m->mu; k++, to += n * LANES, x += width * LANES) {
                if (matrix->time)
                    EACH to[l] += a[l] * x[l];
                else
                    EACH to[l] += once * x[l];
            }
        }
}

/* g = (f_0, …, f_mu) in scaled rows and time, at one block of times. */
EVERY_WIDTH static void force(const Model *m, Forcing *f, npy_intp first, npy_intp used)
{
    const npy_intp n = m->n, orders = m->mu + 1;
    if (f->B.time)
        gather(f->of_B, &f->B, orders, first, used);
    if (f->F.time)
        gather(f->of_F, &f->F, orders, first, used);
    gather(f->of_u, &f->u, orders, first, used);
    gather(f->of_theta, &f->theta, orders, first, used);
    memset(f->f, 0, orders * n * LANES * sizeof(double));
    if (f->unknowns)
        add_product(m, f->f, &f->F, f->of_F, f->of_theta, f->unknowns);
    if (f->inputs)
        add_product(m, f->f, &f->B, f->of_B, f->of_u, f->inputs);
    double power = 1.0;
    for (npy_intp k = 0; k < orders; k++, power *= m->time)
        for (npy_intp i = 0; i < n; i++) {
            const double weight = power * m->rows[i];
            EACH f->f[(k * n + i) * LANES + l] *= weight;
        }
}

/* x (rows, columns, LANES) to the times first … first + used − 1 of out (N, rows, columns), times
   factors of the columns where given. */
static void scatter(double *out, const double *x, npy_intp rows, npy_intp columns, npy_intp first,
                    npy_intp used, const double *factors)
{
    const npy_intp entries = rows * columns;
    for (npy_intp l = 0; l < used; l++) {
        double *to = out + (first + l) * entries;
        const double *from = x + l;
        for (npy_intp i = 0; i < rows; i++)
            for (npy_intp j = 0; j < columns; j++, from += LANES)
                *to++ = factors ? *from * factors[j] : *from;
    }
}

/* What leaves `reduced` and `reduced_constant`. */
typedef struct {
    PyArrayObject *known, *E1, *A1, *f1, *A2, *f2, *basis, *offset, *amplification;
} Reduced;

static int make(Call *call, npy_intp n, npy_intp d, npy_intp times, npy_intp matrices, Reduced *out)
{
    const npy_intp a = n - d;
    return (out->known = zeros(call, 1, (npy_intp[]){1})) != NULL &&
           (out->E1 = fresh(call, 3, (npy_intp[]){matrices, d, n})) != NULL &&
           (out->A1 = fresh(call, 3, (npy_intp[]){matrices, d, n})) != NULL &&
           (out->f1 = fresh(call, 2, (npy_intp[]){times, d})) != NULL &&
           (out->A2 = fresh(call, 3, (npy_intp[]){matrices, a, n})) != NULL &&
           (out->f2 = fresh(call, 2, (npy_intp[]){times, a})) != NULL &&
           (out->basis = fresh(call, 3, (npy_intp[]){matrices, n, d})) != NULL &&
           (out->offset = fresh(call, 2, (npy_intp[]){times, n})) != NULL &&
           (out->amplification = zeros(call, 2, (npy_intp[]){n, n + 1})) != NULL;
}

static PyObject *handed_over(Call *call, const Reduced *out)
{
    return results(call, 9, out->known, out->E1, out->A1, out->f1, out->A2, out->f2, out->basis,
                   out->offset, out->amplification);
}

/* Size of the terms of [Â2 | f2] in one lane (a, n + 1): of those in the remaining rows, and |X|
   times those in the pivots' rows and |M11| |Y|, twice, where M11 Y = [N1 | g1] are the higher
   derivatives. M11, transposed, is what the last solution has kept. own: r (r + n + 1) numbers. */
static void terms(const Model *m, const Elimination *el, const double *g, npy_intp l, double *own,
                  double *size)
{
    const npy_intp n = m->n, r = el->rank, width = n + 1;
    double *M11 = own, *Y = own + r * r;
    for (npy_intp i = 0; i < r; i++) {
        for (npy_intp k = 0; k < r; k++)
            M11[i * r + k] = el->memory[(k * r + i) * LANES + l];
        for (npy_intp j = 0; j < n; j++)
            Y[i * width + j] = el->N1[(i * n + j) * LANES + l];
        Y[i * width + n] = g[el->rows[i] * LANES + l];
    }
    solve_in_place(M11, Y, r, width);
    for (npy_intp i = 0; i < el->a; i++, size += width) {
        const double *rest = el->N2 + i * n * LANES + l;
        for (npy_intp j = 0; j < n; j++)
            size[j] = fabs(rest[j * LANES]);
        size[n] = fabs(g[el->rows[r + i] * LANES + l]);
        for (npy_intp k = 0; k < r; k++) {
            const double x = fabs(el->X[(i * r + k) * LANES + l]);
            const double *other = el->N1 + k * n * LANES + l;
            if (x == 0.0)
                continue;
            for (npy_intp j = 0; j < n; j++)
                size[j] += x * fabs(other[j * LANES]);
            size[n] += x * fabs(g[el->rows[k] * LANES + l]);
            for (npy_intp q = 0; q < r; q++) {
                const double factor = 2.0 * x * fabs(el->memory[(q * r + k) * LANES + l]);
                if (factor != 0.0)
                    for (npy_intp j = 0; j < width; j++)
                        size[j] += factor * fabs(Y[q * width + j]);
            }
        }
    }
}

/* Raises most (n, width), whose rows are `skip` apart, to |P| size where P are the last a columns
   of inverse (n, n), numbers of which are `apart` apart, and size (a, width). */
static void raise_to(double *most, npy_intp skip, const double *inverse, npy_intp apart,
                     const double *size, npy_intp n, npy_intp a, npy_intp width)
{
    for (npy_intp i = 0; i < n; i++)
        for (npy_intp j = 0; j < width; j++) {
            double sum = 0.0;
            for (npy_intp k = 0; k < a; k++)
                sum += fabs(inverse[(i * n + n - a + k) * apart]) * size[k * width + j];
            most[i * skip + j] = sum > most[i * skip + j] ? sum : most[i * skip + j];
        }
}

/* Relative rounding of the model's own states, not of the scaled ones. */
static void unscale(const Model *m, double *amplification)
{
    for (npy_intp i = 0; i < m->n; i++)
        for (npy_intp j = 0; j < m->n; j++)
            amplification[i * (m->n + 1) + j] /= m->columns[j];
}

/* [Z1ᵀE; Â2]⁻¹, its rows times the states' scales, into inverse; where it grows more than that,
   lanes of `good` become 0. Rows are judged by their own size. whole is used up. */
EVERY_WIDTH static void invert(const Model *m, Elimination *el, double most_growth, double *good)
{
    const npy_intp n = m->n;
    double scale[LANES], grown[LANES];
    identity(el->inverse, n);
    for (npy_intp i = 0; i < n; i++) {
        double *row = el->whole + i * n * LANES, *factor = el->scale + i * LANES;
        EACH scale[l] = DBL_MIN;
        for (npy_intp j = 0; j < n; j++)
            EACH
            {
                const double x = fabs(row[j * LANES + l]);
                scale[l] = x > scale[l] ? x : scale[l];
            }
        EACH factor[l] = 1.0 / scale[l];
        for (npy_intp j = 0; j < n; j++)
            EACH row[j * LANES + l] *= factor[l];
    }
    solve_lanes(el->whole, el->inverse, n, n, el->memory);
    norms(el->inverse, n * n, grown);
    EACH good[l] = grown[l] <= most_growth ? good[l] : 0.0;
    for (npy_intp i = 0; i < n; i++)
        for (npy_intp j = 0; j < n; j++) {
            double *x = el->inverse + (i * n + j) * LANES;
            const double *factor = el->scale + j * LANES;
            EACH x[l] *= factor[l] * m->columns[i];
        }
}

/* reduced(E, A, rows, columns, time, mu, B, F, u, theta, pivot rows, pivot columns, rank, Z1,
   every, growth, residual) -> known (1,), E1, A1 (N, d, n), f1 (N, d), A2 (N, a, n), f2 (N, a),
   basis (N, n, d), offset (N, n), amplification (n, n + 1): the strangeness-free equations in the
   model's own states. The amplification is looked at at every so many times. Where the elimination
   grows more than `growth` at some time or leaves more than `residual`, known is 0 and the rest
   means nothing. */
static PyObject *reduced(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Model m;
    Elimination el;
    Forcing f;
    Reduced out;
    npy_intp every;
    double growth, residual;
    if (!begin(&call, given, count, 17))
        return NULL;
    if (!model(&call, &m) || !forcing(&call, &m, &f) || !elimination(&call, 10, &m, &el) ||
        !whole_number(&call, 14, &every) || !number(&call, 15, &growth) ||
        !number(&call, 16, &residual))
        return failed(&call);
    const npy_intp n = m.n, r = el.rank, a = el.a, d = el.d, times = f.times;
    if (every < 1) {
        PyErr_SetString(PyExc_ValueError, "it takes a look at every time, or less often");
        return failed(&call);
    }
    double *buffer = make(&call, n, d, times, times, &out)
                         ? old_scratch(&call, LANES * (n * n + 2 * n + a * (n + 1)) + 3 * n + r * (r + n + 1))
                         : NULL;
    if (buffer == NULL)
        return failed(&call);
    double *vector = buffer + n * (n + 1) * LANES, *sizes = vector + n * LANES;
    double *of_E1 = sizes + LANES * a * (n + 1), *of_A = of_E1 + n, *of_basis = of_A + n, *own = of_basis + n;
    for (npy_intp j = 0; j < n; j++) {
        of_E1[j] = m.time / m.columns[j];
        of_A[j] = 1.0 / m.columns[j];
        of_basis[j] = 1.0 / m.time;
    }
    for (npy_intp first = 0; first < times; first += LANES) {
        const npy_intp used = times - first < LANES ? times - first : LANES;
        fill(&m, &el, first, used, 1);
        force(&m, &f, first, used);
        solve_lanes(el.M11, el.M21, r, a, el.memory);
        for (npy_intp i = 0; i < a; i++)
            for (npy_intp k = 0; k < r; k++)
                memcpy(el.X + (i * r + k) * LANES, el.M21 + (k * a + i) * LANES,
                       LANES * sizeof(double));
        for (npy_intp l = 0; l < used; l++)
            if ((first + l) % every == 0)
                terms(&m, &el, f.f, l, own, sizes + l * a * (n + 1));
        eliminate(&m, &el);
        double good[LANES];
        EACH good[l] = el.residual[l] <= residual * el.of_M[l] && el.of_X[l] <= growth ? 1.0 : 0.0;
        scatter(data(out.E1), el.whole, d, n, first, used, of_E1);
        multiply_same(buffer, el.Z1, el.a_, d, n, n);
        scatter(data(out.A1), buffer, d, n, first, used, of_A);
        multiply_same(buffer, el.Z1, f.f, d, n, 1);
        scatter(data(out.f1), buffer, 1, d, first, used, NULL);
        scatter(data(out.A2), el.N2, a, n, first, used, of_A);
        for (npy_intp i = 0; i < a; i++) {
            double *to = vector + i * LANES;
            memcpy(to, f.f + el.rows[r + i] * LANES, LANES * sizeof(double));
            for (npy_intp k = 0; k < r; k++) {
                const double *x = el.X + (i * r + k) * LANES, *g = f.f + el.rows[k] * LANES;
                EACH to[l] -= x[l] * g[l];
            }
        }
        scatter(data(out.f2), vector, 1, a, first, used, NULL);
        invert(&m, &el, growth, good);
        for (npy_intp l = 0; l < used; l++) {
            if (good[l] == 0.0)
                return handed_over(&call, &out);
            if ((first + l) % every == 0)
                raise_to(data(out.amplification), n + 1, el.inverse + l, LANES,
                         sizes + l * a * (n + 1), n, a, n + 1);
        }
        for (npy_intp i = 0; i < n; i++) {
            memcpy(buffer + i * d * LANES, el.inverse + i * n * LANES, d * LANES * sizeof(double));
            double *to = buffer + n * d * LANES + i * LANES;
            EACH to[l] = 0.0;
            for (npy_intp k = 0; k < a; k++) {
                const double *x = el.inverse + (i * n + d + k) * LANES;
                EACH to[l] -= x[l] * vector[k * LANES + l];
            }
        }
        scatter(data(out.basis), buffer, n, d, first, used, of_basis);
        scatter(data(out.offset), buffer + n * d * LANES, 1, n, first, used, NULL);
    }
    unscale(&m, data(out.amplification));
    data(out.known)[0] = 1.0;
    return handed_over(&call, &out);
}

PyMethodDef reduction_kernels[] = {
    KERNEL(all_levels),
    KERNEL(reduced),
    {NULL, NULL, 0, NULL},
};
