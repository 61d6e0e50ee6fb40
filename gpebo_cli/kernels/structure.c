/* gpebo_cli/simulation: derivative arrays, the strangeness-free system, consistent states. */
#include "common.h"

#include <float.h>

/* Times that are worked on side by side: what is one number for one time is LANES numbers in a
   row, so that loops over small matrices are paid for once and vectorised. */
#define LANES 8
#define SWEEPS 40      /* of Jacobi rotations; a handful suffices */
#define ALMOST 1e-9    /* cosines between rows after which one sweep more leaves none */
#define MULTIPLIER 4.0 /* of an elimination on shared pivots; beyond it a time gets its own */

/* ---- arguments --------------------------------------------------------------------------- */

/* Taylor coefficients (K + 1, N or 1, …) wherever they lie; what is constant in time is read with
   a stride of 0. Strides are in numbers. */
typedef struct {
    const double *at;
    npy_intp orders, times, entries, order, time;
} Series;

/* One argument as a Series with `axes` axes; only matrices that are not by rows are copied. */
static int series(Call *call, Py_ssize_t place, int axes, Series *out)
{
    PyObject *given = call->given[place];
    PyArrayObject *array = (PyArrayObject *)given;
    int usable = PyArray_Check(given) && PyArray_TYPE(array) == NPY_DOUBLE &&
                 PyArray_NDIM(array) == axes && PyArray_ISBEHAVED_RO(array);
    npy_intp step = sizeof(double), entries = 1;
    for (int axis = axes - 1; usable && axis >= 2; axis--) {
        usable = size(array, axis) <= 1 || PyArray_STRIDE(array, axis) == step;
        step *= size(array, axis);
    }
    if (!usable && (array = doubles(call, place, axes)) == NULL)
        return 0;
    for (int axis = 2; axis < axes; axis++)
        entries *= size(array, axis);
    out->at = data(array);
    out->orders = size(array, 0);
    out->times = size(array, 1);
    out->entries = entries;
    out->order = PyArray_STRIDE(array, 0) / (npy_intp)sizeof(double);
    out->time = out->times == 1 ? 0 : PyArray_STRIDE(array, 1) / (npy_intp)sizeof(double);
    return 1;
}

/* E and A of a model with the scalings of its rows, states and time, differentiated mu times. */
typedef struct {
    Series E, A;
    const double *rows, *columns; /* (n,) */
    double time;
    npy_intp n, mu, size, times; /* size = (mu + 1) n, times = N */
} Model;

/* Arguments 0 to 5: E, A (K + 1, N or 1, n, n), rows, columns (n,), time and mu. */
static int model(Call *call, Model *m)
{
    if (!series(call, 0, 4, &m->E) || !series(call, 1, 4, &m->A))
        return 0;
    PyArrayObject *rows = doubles(call, 2, 1), *columns = rows ? doubles(call, 3, 1) : NULL;
    if (columns == NULL || !number(call, 4, &m->time) || !whole_number(call, 5, &m->mu))
        return 0;
    m->n = size(rows, 0);
    m->rows = data(rows);
    m->columns = data(columns);
    m->size = (m->mu + 1) * m->n;
    m->times = m->E.times > m->A.times ? m->E.times : m->A.times;
    PyArrayObject *E = (PyArrayObject *)call->given[0], *A = (PyArrayObject *)call->given[1];
    if (!same("columns and rows", size(columns, 0), m->n) ||
        !same("rows of E", size(E, 2), m->n) || !same("columns of E", size(E, 3), m->n) ||
        !same("rows of A", size(A, 2), m->n) || !same("columns of A", size(A, 3), m->n) ||
        !(m->E.times == m->times || same("times of E", m->E.times, 1)) ||
        !(m->A.times == m->times || same("times of A", m->A.times, 1)))
        return 0;
    if (m->n < 1 || m->mu < 0 || m->times < 1 || m->E.orders <= m->mu || m->A.orders <= m->mu) {
        PyErr_SetString(PyExc_ValueError, "fewer Taylor coefficients than mu + 1, or none");
        return 0;
    }
    return 1;
}

/* ---- one time ---------------------------------------------------------------------------- */

/* e and a (mu + 1, n, n): the scaled coefficients at time t. */
static void scaled(const Model *m, npy_intp t, double *e, double *a)
{
    const npy_intp n = m->n;
    double power = 1.0;
    for (npy_intp k = 0; k <= m->mu; k++, power *= m->time) {
        const double *E = m->E.at + k * m->E.order + t * m->E.time;
        const double *A = m->A.at + k * m->A.order + t * m->A.time;
        for (npy_intp i = 0; i < n; i++)
            for (npy_intp j = 0; j < n; j++) {
                const double weight = m->rows[i] * m->columns[j];
                *e++ = E[i * n + j] * weight * power / m->time;
                *a++ = A[i * n + j] * weight * power;
            }
    }
}

/* M (size, size), M_ij = (j + 1) e_{i−j} − a_{i−j−1}, from e and a of one time. */
static void derivative_array(const Model *m, const double *e, const double *a, double *M)
{
    const npy_intp n = m->n, size = m->size;
    memset(M, 0, size * size * sizeof(double));
    for (npy_intp i = 0; i <= m->mu; i++)
        for (npy_intp j = 0; j <= i; j++)
            for (npy_intp p = 0; p < n; p++) {
                double *row = M + (i * n + p) * size + j * n;
                const double *of_e = e + ((i - j) * n + p) * n;
                const double *of_a = j < i ? a + ((i - j - 1) * n + p) * n : NULL;
                for (npy_intp q = 0; q < n; q++)
                    row[q] = (double)(j + 1) * of_e[q] - (of_a ? of_a[q] : 0.0);
            }
}

static double dot(const double *x, const double *y, npy_intp length)
{
    double sum = 0.0;
    for (npy_intp i = 0; i < length; i++)
        sum += x[i] * y[i];
    return sum;
}

static double norm(const double *x, npy_intp length)
{
    return sqrt(dot(x, x, length)) + DBL_MIN;
}

/* W (rows, length), rows ≤ length, becomes P W = L Qᵀ by Householder's reflections: L, lower
   triangular, is left in W, and in `mirrors` (rows, length) the vectors v of Q = Π (I − v vᵀ).
   With `order` (rows,) the row with the most left comes next, order[k] being the one that came
   k-th; without it, rows stay where they are. */
static void triangularise(double *W, npy_intp rows, npy_intp length, double *mirrors,
                          npy_intp *order)
{
    for (npy_intp k = 0; order && k < rows; k++)
        order[k] = k;
    for (npy_intp k = 0; k < rows; k++) {
        const npy_intp left = length - k;
        if (order) {
            npy_intp best = k;
            double most = -1.0;
            for (npy_intp i = k; i < rows; i++) {
                const double square = dot(W + i * length + k, W + i * length + k, left);
                if (square > most)
                    most = square, best = i;
            }
            if (best != k) {
                for (npy_intp j = 0; j < length; j++) {
                    const double kept = W[k * length + j];
                    W[k * length + j] = W[best * length + j];
                    W[best * length + j] = kept;
                }
                const npy_intp kept = order[k];
                order[k] = order[best];
                order[best] = kept;
            }
        }
        double *row = W + k * length + k, *v = mirrors + k * length;
        memset(v, 0, length * sizeof(double));
        v += k;
        const double length_of_row = sqrt(dot(row, row, left));
        if (length_of_row == 0.0 || left == 1)
            continue;
        const double first = row[0] > 0.0 ? -length_of_row : length_of_row;
        /* v vᵀ with |v|² = 2 */
        const double head = row[0] - first, factor = 1.0 / sqrt(-first * head);
        v[0] = head * factor;
        for (npy_intp j = 1; j < left; j++)
            v[j] = row[j] * factor;
        row[0] = first;
        memset(row + 1, 0, (left - 1) * sizeof(double));
        for (npy_intp i = k + 1; i < rows; i++) {
            double *other = W + i * length + k;
            const double along = dot(other, v, left);
            for (npy_intp j = 0; j < left; j++)
                other[j] -= along * v[j];
        }
    }
}

/* Columns `from` … length − 1 of Q as rows of out (length − from, length). */
static void columns_of_q(const double *mirrors, npy_intp rows, npy_intp length, npy_intp from,
                         double *out)
{
    for (npy_intp j = from; j < length; j++, out += length) {
        memset(out, 0, length * sizeof(double));
        out[j] = 1.0;
        for (npy_intp k = (j < rows ? j + 1 : rows) - 1; k >= 0; k--) {
            const double *v = mirrors + k * length;
            const double along = dot(out + k, v + k, length - k);
            for (npy_intp i = k; i < length; i++)
                out[i] -= along * v[i];
        }
    }
}

/* Rotates the rows of W (rows, length) among themselves until they are orthogonal (one-sided
   Jacobi); their lengths, sigma (rows,), are its singular values. 0 where it does not settle. */
static int orthogonalise(double *W, npy_intp rows, npy_intp length, double *sigma)
{
    const double enough = DBL_EPSILON * (double)(length + 1);
    for (int sweep = 0; sweep < SWEEPS; sweep++) {
        double total = 0.0, worst = 0.0;
        for (npy_intp i = 0; i < rows; i++)
            total += sigma[i] = dot(W + i * length, W + i * length, length);
        if (!(total < DBL_MAX) || (total > 0.0 && total < 1e-280))
            return 0; /* squares that overflow, or are too small to be told apart */
        const double rounding = 0.0625 * DBL_EPSILON * DBL_EPSILON * total;
        for (npy_intp p = 0; p < rows; p++)
            for (npy_intp q = p + 1; q < rows; q++) {
                const double one = sigma[p], other = sigma[q];
                if (one <= rounding || other <= rounding)
                    continue;
                double *restrict x = W + p * length, *restrict y = W + q * length;
                const double product = dot(x, y, length);
                const double cosine = fabs(product) / sqrt(one * other);
                if (cosine <= enough)
                    continue;
                if (cosine > worst)
                    worst = cosine;
                const double zeta = (other - one) / (2.0 * product);
                const double sign = zeta >= 0.0 ? 1.0 : -1.0;
                const double t = sign / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
                const double c = 1.0 / sqrt(1.0 + t * t), s = c * t;
                for (npy_intp j = 0; j < length; j++) {
                    const double kept = x[j];
                    x[j] = c * kept - s * y[j];
                    y[j] = s * kept + c * y[j];
                }
                sigma[p] = one - t * product > 0.0 ? one - t * product : 0.0;
                sigma[q] = other + t * product > 0.0 ? other + t * product : 0.0;
            }
        if (worst <= ALMOST) {
            for (npy_intp i = 0; i < rows; i++)
                sigma[i] = sqrt(dot(W + i * length, W + i * length, length));
            return 1;
        }
    }
    return 0;
}

/* Sorts sigma (count,) from large to small, and the rows of W (count, length) with it. */
static void sort_down(double *sigma, double *W, npy_intp count, npy_intp length)
{
    for (npy_intp i = 1; i < count; i++)
        for (npy_intp k = i; k > 0 && sigma[k] > sigma[k - 1]; k--) {
            const double kept = sigma[k];
            sigma[k] = sigma[k - 1];
            sigma[k - 1] = kept;
            for (npy_intp j = 0; W && j < length; j++) {
                const double number = W[k * length + j];
                W[k * length + j] = W[(k - 1) * length + j];
                W[(k - 1) * length + j] = number;
            }
        }
}

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

static int prepare(Call *call, const Model *m, Look *look)
{
    const npy_intp n = m->n, size = m->size, many = size * size;
    double *memory = scratch(call, 2 * n * size + 4 * many + size + size * size + 3 * n * n);
    PyArrayObject *order = memory ? fresh_indices(call, size) : NULL;
    if (order == NULL)
        return 0;
    look->order = (npy_intp *)PyArray_DATA(order);
    look->e = memory;
    look->a = look->e + n * size;
    look->M = look->a + n * size;
    look->W = look->M + many;
    look->mirrors = look->W + many;
    look->square = look->mirrors + many;
    look->sigma = look->square + many;
    look->Z2 = look->sigma + size;
    look->A2 = look->Z2 + many;
    look->T2 = look->A2 + n * n;
    look->Z1 = look->T2 + n * n;
    return 1;
}

/* Singular values of L (rows, rows) in the upper left of W (…, length), lower triangular: those
   of its columns, which its triangularisation has made almost orthogonal. */
static int triangular_values(const double *W, npy_intp rows, npy_intp length, double *square,
                             double *sigma)
{
    for (npy_intp i = 0; i < rows; i++)
        for (npy_intp j = 0; j < rows; j++)
            square[j * rows + i] = W[i * length + j];
    return orthogonalise(square, rows, rows, sigma);
}

/* Levels at time t, `constraints` < 0: as many as M has singular values that are at most rank_tol
   times its size; `upto` says how many of the three are asked for. 0 where singular values and
   elimination do not see the same rank, or nothing converges: LAPACK has to look. */
static int look_at(const Model *m, npy_intp t, npy_intp constraints, double rank_tol, int upto,
                   Look *look)
{
    const npy_intp n = m->n, size = m->size;
    look->smallest[0] = look->smallest[1] = look->smallest[2] = HUGE_VAL;
    scaled(m, t, look->e, look->a);
    derivative_array(m, look->e, look->a, look->M);
    double largest = 0.0, all = 0.0;
    for (npy_intp i = 0; i < n * size; i++) {
        all += look->a[i] + look->e[i];
        largest = fabs(look->a[i]) > largest ? fabs(look->a[i]) : largest;
    }
    if (!(fabs(all) < DBL_MAX))
        return 0;
    memcpy(look->W, look->M, size * size * sizeof(double));
    triangularise(look->W, size, size, look->mirrors, look->order);
    /* Rows of W with nothing left but rounding: the left kernel is perpendicular to the rest. */
    npy_intp rank = 0;
    const double rounding = 4.0 * DBL_EPSILON * (double)size * fabs(look->W[0]);
    while (rank < size && fabs(look->W[rank * size + rank]) > rounding)
        rank++;
    double *columns = look->M; /* M is used up: (rank, size), the columns of L */
    for (npy_intp i = 0; i < rank; i++)
        for (npy_intp j = 0; j < size; j++)
            columns[i * size + j] = look->W[j * size + i];
    const double noise = rank < size ? fabs(look->W[rank * size + rank]) : 0.0;
    triangularise(columns, rank, size, look->mirrors, NULL);
    if (!triangular_values(columns, rank, size, look->square, look->sigma))
        return 0;
    sort_down(look->sigma, NULL, rank, 0);
    for (npy_intp i = rank; i < size; i++)
        look->sigma[i] = i == rank ? noise : 0.0;
    double scale = look->sigma[0] > largest ? look->sigma[0] : largest;
    scale = scale > DBL_MIN ? scale : DBL_MIN;
    npy_intp counted = 0;
    for (npy_intp i = 0; i < size; i++) {
        look->sigma[i] /= scale;
        counted += look->sigma[i] > rank_tol;
    }
    const npy_intp r = constraints < 0 ? counted : size - constraints, a = size - r;
    look->constraints = a;
    if (a > n || r < 0)
        return a > n && constraints < 0;
    if (r)
        look->smallest[0] = look->sigma[r - 1];
    if (upto < 2)
        return 1;
    if (rank != r)
        return 0;
    columns_of_q(look->mirrors, r, size, r, look->W);
    for (npy_intp i = 0; i < a; i++)
        for (npy_intp j = 0; j < size; j++)
            look->Z2[i * size + look->order[j]] = look->W[i * size + j];
    multiply(look->A2, look->Z2, look->a, a, size, n); /* N is a_0 … a_mu, one below the other */
    triangularise(look->A2, a, n, look->mirrors, look->order);
    if (!triangular_values(look->A2, a, n, look->square, look->sigma))
        return 0;
    const double of_N = norm(look->a, n * size), of_E = norm(look->e, n * n);
    if (!(of_N < DBL_MAX && of_E < DBL_MAX))
        return 0;
    for (npy_intp i = 0; i < a; i++)
        if (look->sigma[i] / of_N < look->smallest[1])
            look->smallest[1] = look->sigma[i] / of_N;
    if (upto < 3)
        return 1;
    columns_of_q(look->mirrors, a, n, a, look->T2);
    const npy_intp d = n - a;
    for (npy_intp j = 0; j < d; j++)
        for (npy_intp i = 0; i < n; i++)
            look->Z1[j * n + i] = dot(look->e + i * n, look->T2 + j * n, n);
    if (!orthogonalise(look->Z1, d, n, look->sigma))
        return 0;
    sort_down(look->sigma, look->Z1, d, n);
    for (npy_intp j = 0; j < d; j++)
        for (npy_intp i = 0; look->sigma[j] > 0.0 && i < n; i++)
            look->Z1[j * n + i] /= look->sigma[j];
    if (d)
        look->smallest[2] = look->sigma[d - 1] / of_E;
    return 1;
}

/* levels(E, A, rows, columns, time, mu, constraints, column) -> known (1,), smallest (N,): the
   singular values (column 0: of M, 1: of Â2, 2: of E T2) that belong to so many constraints,
   relative to the size of their factors. known is 0 where LAPACK has to look. */
static PyObject *levels(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Model m;
    Look look;
    npy_intp constraints, column;
    if (!begin(&call, given, count, 8))
        return NULL;
    if (!model(&call, &m) || !whole_number(&call, 6, &constraints) ||
        !whole_number(&call, 7, &column) || !prepare(&call, &m, &look))
        return failed(&call);
    if (constraints < 0 || constraints > m.n || column < 0 || column > 2) {
        PyErr_SetString(PyExc_ValueError, "no such level");
        return failed(&call);
    }
    PyArrayObject *known = zeros(&call, 1, (npy_intp[]){1});
    PyArrayObject *smallest = known ? fresh(&call, 1, (npy_intp[]){m.times}) : NULL;
    if (smallest == NULL)
        return failed(&call);
    npy_intp t = 0;
    while (t < m.times && look_at(&m, t, constraints, 0.0, (int)column + 1, &look))
        data(smallest)[t++] = look.smallest[column];
    data(known)[0] = t == m.times;
    return results(&call, 2, known, smallest);
}

/* Rows and columns of left (size, size) that carry its rank, `count` of them first and the others
   behind them, each in their order: elimination with complete pivoting. 0 if a pivot is zero. */
static int pivots(double *left, npy_intp size, npy_intp count, npy_intp *rows, npy_intp *columns)
{
    for (npy_intp i = 0; i < size; i++)
        rows[i] = columns[i] = 0;
    for (npy_intp k = 0; k < count; k++) {
        npy_intp best = 0;
        for (npy_intp i = 1; i < size * size; i++)
            if (fabs(left[i]) > fabs(left[best]))
                best = i;
        const npy_intp p = best / size, q = best % size;
        const double pivot = left[best];
        if (pivot == 0.0)
            return 0;
        rows[p] = columns[q] = 1;
        for (npy_intp i = 0; i < size; i++) {
            const double factor = left[i * size + q] / pivot;
            if (i == p || factor == 0.0)
                continue;
            for (npy_intp j = 0; j < size; j++)
                left[i * size + j] -= factor * left[p * size + j];
            left[i * size + q] = 0.0;
        }
        memset(left + p * size, 0, size * sizeof(double));
    }
    return 1;
}

/* Turns flags (size,) into the places that are flagged, followed by those that are not. */
static void flagged_first(npy_intp *flags, npy_intp size, npy_intp *memory)
{
    npy_intp next = 0;
    for (npy_intp i = 0; i < size; i++)
        if (flags[i])
            memory[next++] = i;
    for (npy_intp i = 0; i < size; i++)
        if (!flags[i])
            memory[next++] = i;
    memcpy(flags, memory, size * sizeof(npy_intp));
}

/* Z1ᵀ A T (d, d) where something has been looked at, NaN where [Z1ᵀE; Z2ᵀN] is singular; T are the
   first columns of its inverse. memory: 2 n² numbers. */
static void dynamics_of(const Model *m, const Look *look, double *memory, double *out)
{
    const npy_intp n = m->n, a = look->constraints, d = n - a;
    double *whole = memory, *inverse = memory + n * n;
    multiply(whole, look->Z1, look->e, d, n, n);
    multiply(whole + d * n, look->Z2, look->a, a, m->size, n);
    memset(inverse, 0, n * n * sizeof(double));
    for (npy_intp i = 0; i < n; i++)
        inverse[i * n + i] = 1.0;
    const int regular = solve_in_place(whole, inverse, n, n);
    multiply(whole, look->Z1, look->a, d, n, n);
    for (npy_intp i = 0; i < d; i++)
        for (npy_intp j = 0; j < d; j++) {
            double sum = regular ? 0.0 : (double)NAN;
            for (npy_intp k = 0; k < n; k++)
                sum += whole[i * n + k] * inverse[k * n + j];
            out[i * d + j] = sum;
        }
}

/* start(E, A, rows, columns, time, mu, place, rank_tol) -> known (2,), smallest (1, 3),
   rows, columns (size,), Z1 (n, d), Z2 (size, a), dynamics (1, d, d) at one of the times, where to
   start from at the others. known says whether, and how many constraints there are: with more
   than n of them, or where LAPACK has to look, the rest means nothing. The dynamics Z1ᵀA T are NaN
   where [Z1ᵀE; Z2ᵀN] is singular. */
static PyObject *start(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Model m;
    Look look;
    npy_intp place;
    double rank_tol;
    if (!begin(&call, given, count, 8))
        return NULL;
    if (!model(&call, &m) || !whole_number(&call, 6, &place) || !number(&call, 7, &rank_tol) ||
        !prepare(&call, &m, &look))
        return failed(&call);
    if (place < 0 || place >= m.times) {
        PyErr_SetString(PyExc_ValueError, "no such time");
        return failed(&call);
    }
    int seen = look_at(&m, place, -1, rank_tol, 3, &look);
    const npy_intp n = m.n, size = m.size, a = seen && look.constraints <= n ? look.constraints : 0;
    const npy_intp d = n - a;
    PyArrayObject *known = fresh(&call, 1, (npy_intp[]){2});
    PyArrayObject *smallest = known ? fresh(&call, 2, (npy_intp[]){1, 3}) : NULL;
    PyArrayObject *rows = smallest ? fresh_indices(&call, size) : NULL;
    PyArrayObject *columns = rows ? fresh_indices(&call, size) : NULL;
    PyArrayObject *Z1 = columns ? zeros(&call, 2, (npy_intp[]){n, d}) : NULL;
    PyArrayObject *Z2 = Z1 ? zeros(&call, 2, (npy_intp[]){size, a}) : NULL;
    PyArrayObject *dynamics = Z2 ? fresh(&call, 3, (npy_intp[]){1, d, d}) : NULL;
    double *whole = dynamics ? scratch(&call, 2 * n * n) : NULL;
    if (whole == NULL)
        return failed(&call);
    memcpy(data(smallest), look.smallest, sizeof(look.smallest));
    npy_intp *first = (npy_intp *)PyArray_DATA(rows), *second = (npy_intp *)PyArray_DATA(columns);
    memset(first, 0, size * sizeof(npy_intp));
    memset(second, 0, size * sizeof(npy_intp));
    if (seen && look.constraints <= n) {
        for (npy_intp i = 0; i < n; i++)
            for (npy_intp j = 0; j < d; j++)
                data(Z1)[i * d + j] = look.Z1[j * n + i];
        for (npy_intp i = 0; i < size; i++)
            for (npy_intp j = 0; j < a; j++)
                data(Z2)[i * a + j] = look.Z2[j * size + i];
        dynamics_of(&m, &look, whole, data(dynamics));
        derivative_array(&m, look.e, look.a, look.M);
        seen = pivots(look.M, size, size - a, first, second);
        flagged_first(first, size, look.order);
        flagged_first(second, size, look.order);
    }
    data(known)[0] = seen;
    data(known)[1] = (double)look.constraints;
    return results(&call, 7, known, smallest, rows, columns, Z1, Z2, dynamics);
}

/* ---- LANES times at once ----------------------------------------------------------------- */

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
static void solve_lanes(double *restrict A, double *restrict B, npy_intp n, npy_intp columns,
                        double *restrict memory)
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
        EACH {
            good[l] = fabs(pivot[l]) > 0.0 ? good[l] : 0.0;
            pivot[l] = 1.0 / pivot[l];
        }
        const double *known = B + k * columns * LANES;
        for (npy_intp i = k + 1; i < n; i++) {
            double *row = A + (i * n + k) * LANES, *right = B + i * columns * LANES;
            if (nothing(row))
                continue;
            double factor[LANES];
            EACH {
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
static void multiply_lanes(double *restrict C, const double *restrict A, const double *restrict B,
                           npy_intp rows, npy_intp inner, npy_intp columns, int subtract)
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
static void multiply_same(double *restrict C, const double *restrict A, const double *restrict B,
                          npy_intp rows, npy_intp inner, npy_intp columns)
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
static void norms(const double *x, npy_intp count, double *out)
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
    double *memory = where ? scratch(call, LANES * (4 * n * size + size * size + 2 * a * r +
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
    double **parts[] = {&el->raw_e, &el->raw_a, &el->e,  &el->a_, &el->M11,   &el->M12,   &el->M21,
                        &el->M22,   &el->X,     &el->N1, &el->N2, &el->whole, &el->inverse,
                        &el->scale};
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
                                           : (p - from) * (right - left) + q - left) * LANES;
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
static void fill(const Model *m, Elimination *el, npy_intp first, npy_intp used, int transposed)
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
            EACH {
                const double x = fabs(el->a_[i * LANES + l]);
                el->largest[l] = x > el->largest[l] ? x : el->largest[l];
            }
    }
    for (npy_intp p = 0; p < size; p++)
        memcpy((p < r ? el->N1 + p * n * LANES : el->N2 + (p - r) * n * LANES),
               el->a_ + (el->block[p] * n + el->within[p]) * n * LANES,
               n * LANES * sizeof(double));
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
    double *inverse = closer ? scratch(&call, LANES * (r * r + 2 * n * n)) : NULL;
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
            bound[1] = a ? 1.0 / (determined[l] * sqrt((double)a + el.of_X[l] * el.of_X[l]) *
                                  el.of_N[l])
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
    double *memory = scratch(call, LANES * (m->mu + 1) * (n * width + width + n));
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
static void add_product(const Model *m, double *f, const Series *matrix, const double *lanes,
                        const double *vector, npy_intp width)
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
static void force(const Model *m, Forcing *f, npy_intp first, npy_intp used)
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
   times those in the pivots' rows. */
static void terms(const Model *m, const Elimination *el, const double *g, npy_intp l, double *size)
{
    const npy_intp n = m->n, r = el->rank;
    for (npy_intp i = 0; i < el->a; i++, size += n + 1) {
        const double *own = el->N2 + i * n * LANES + l;
        for (npy_intp j = 0; j < n; j++)
            size[j] = fabs(own[j * LANES]);
        size[n] = fabs(g[el->rows[r + i] * LANES + l]);
        for (npy_intp k = 0; k < r; k++) {
            const double x = fabs(el->X[(i * r + k) * LANES + l]);
            const double *other = el->N1 + k * n * LANES + l;
            if (x == 0.0)
                continue;
            for (npy_intp j = 0; j < n; j++)
                size[j] += x * fabs(other[j * LANES]);
            size[n] += x * fabs(g[el->rows[k] * LANES + l]);
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
static void invert(const Model *m, Elimination *el, double most_growth, double *good)
{
    const npy_intp n = m->n;
    double scale[LANES], grown[LANES];
    identity(el->inverse, n);
    for (npy_intp i = 0; i < n; i++) {
        double *row = el->whole + i * n * LANES, *factor = el->scale + i * LANES;
        EACH scale[l] = DBL_MIN;
        for (npy_intp j = 0; j < n; j++)
            EACH {
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
                         ? scratch(&call, LANES * (n * n + 2 * n + a * (n + 1)) + 3 * n)
                         : NULL;
    if (buffer == NULL)
        return failed(&call);
    double *vector = buffer + n * (n + 1) * LANES, *sizes = vector + n * LANES;
    double *of_E1 = sizes + LANES * a * (n + 1), *of_A = of_E1 + n, *of_basis = of_A + n;
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
                terms(&m, &el, f.f, l, sizes + l * a * (n + 1));
        eliminate(&m, &el);
        double good[LANES];
        EACH good[l] =
            el.residual[l] <= residual * el.of_M[l] && el.of_X[l] <= growth ? 1.0 : 0.0;
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
            memcpy(buffer + i * d * LANES, el.inverse + i * n * LANES,
                   d * LANES * sizeof(double));
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

/* reduced_constant(E, A, rows, columns, time, mu, B, F, u, theta, Z1 (1, n, d), Z2 (1, size, a),
   every) -> as `reduced`, where E and A are constant: matrices have a leading axis of 1. known is
   0 where [Z1ᵀE; Â2] is singular. */
static PyObject *reduced_constant(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Model m;
    Forcing f;
    Reduced out;
    npy_intp every;
    if (!begin(&call, given, count, 13))
        return NULL;
    PyArrayObject *first_basis, *second_basis;
    if (!model(&call, &m) || !forcing(&call, &m, &f) ||
        (first_basis = doubles(&call, 10, 3)) == NULL ||
        (second_basis = doubles(&call, 11, 3)) == NULL || !whole_number(&call, 12, &every))
        return failed(&call);
    const npy_intp n = m.n, size_of_M = m.size, a = size(second_basis, 2), d = n - a;
    const npy_intp times = f.times;
    if (!same("times of Z1", size(first_basis, 0), 1) ||
        !same("times of Z2", size(second_basis, 0), 1) ||
        !same("rows of Z1", size(first_basis, 1), n) ||
        !same("rows of Z2", size(second_basis, 1), size_of_M) ||
        !same("columns of Z1", size(first_basis, 2), d))
        return failed(&call);
    if (every < 1) {
        PyErr_SetString(PyExc_ValueError, "it takes a look at every time, or less often");
        return failed(&call);
    }
    const double *Z1 = data(first_basis), *Z2 = data(second_basis);
    double *e = make(&call, n, d, times, 1, &out)
                    ? scratch(&call, 2 * n * size_of_M + 2 * n * n + a * n + a + 2 * LANES * n)
                    : NULL;
    if (e == NULL)
        return failed(&call);
    double *A = e + n * size_of_M, *whole = A + n * size_of_M, *inverse = whole + n * n;
    double *sizes = inverse + n * n, *of_f2 = sizes + a * n;
    double *vector = of_f2 + a, *lanes = vector + LANES * n;
    scaled(&m, 0, e, A);
    memset(whole, 0, n * n * sizeof(double));
    memset(inverse, 0, n * n * sizeof(double));
    memset(sizes, 0, a * n * sizeof(double));
    double *A1 = data(out.A1), *E1 = data(out.E1), *A2 = whole + d * n;
    memset(A1, 0, d * n * sizeof(double));
    for (npy_intp i = 0; i < n; i++) {
        inverse[i * n + i] = 1.0;
        for (npy_intp k = 0; k < d; k++)
            for (npy_intp j = 0; j < n; j++) {
                whole[k * n + j] += Z1[i * d + k] * e[i * n + j];
                A1[k * n + j] += Z1[i * d + k] * A[i * n + j];
            }
    }
    for (npy_intp p = 0; p < size_of_M; p++)
        for (npy_intp k = 0; k < a; k++)
            for (npy_intp j = 0; j < n; j++) {
                A2[k * n + j] += Z2[p * a + k] * A[p * n + j];
                sizes[k * n + j] += fabs(Z2[p * a + k]) * fabs(A[p * n + j]);
            }
    for (npy_intp j = 0; j < n; j++) {
        for (npy_intp k = 0; k < d; k++) {
            E1[k * n + j] = whole[k * n + j] * m.time / m.columns[j];
            A1[k * n + j] /= m.columns[j];
        }
        for (npy_intp k = 0; k < a; k++)
            data(out.A2)[k * n + j] = A2[k * n + j] / m.columns[j];
    }
    int regular = solve_in_place(whole, inverse, n, n);
    for (npy_intp i = 0; i < n * n; i++) {
        regular = regular && fabs(inverse[i]) < HUGE_VAL;
        inverse[i] *= m.columns[i / n];
    }
    if (!regular)
        return handed_over(&call, &out);
    for (npy_intp i = 0; i < n; i++)
        for (npy_intp j = 0; j < d; j++)
            data(out.basis)[i * d + j] = inverse[i * n + j] / m.time;
    raise_to(data(out.amplification), n + 1, inverse, 1, sizes, n, a, n);
    for (npy_intp first = 0; first < times; first += LANES) {
        const npy_intp used = times - first < LANES ? times - first : LANES;
        force(&m, &f, first, used);
        multiply_same(vector, Z1, f.f, d, n, 1);
        scatter(data(out.f1), vector, 1, d, first, used, NULL);
        multiply_same(vector, Z2, f.f, a, size_of_M, 1);
        scatter(data(out.f2), vector, 1, a, first, used, NULL);
        for (npy_intp i = 0; i < n; i++) {
            double *to = lanes + i * LANES;
            EACH to[l] = 0.0;
            for (npy_intp k = 0; k < a; k++)
                EACH to[l] -= inverse[i * n + d + k] * vector[k * LANES + l];
        }
        scatter(data(out.offset), lanes, 1, n, first, used, NULL);
        for (npy_intp l = 0; l < used; l++) {
            if ((first + l) % every)
                continue;
            for (npy_intp k = 0; k < a; k++) {
                of_f2[k] = 0.0;
                for (npy_intp p = 0; p < size_of_M; p++)
                    of_f2[k] += fabs(Z2[p * a + k] * f.f[p * LANES + l]);
            }
            raise_to(data(out.amplification) + n, n + 1, inverse, 1, of_f2, n, a, 1);
        }
    }
    unscale(&m, data(out.amplification));
    data(out.known)[0] = 1.0;
    return handed_over(&call, &out);
}

/* ---- scalings, dips, consistent states --------------------------------------------------- */

static double power_of_two(double x) { return exp2(rint(log2(x))); }

/* balance(E, A (K + 1, N or 1, n, n)) -> rows, columns (n,), time (1,): powers of two that bring
   rows and columns of E/time and A to comparable size over time; NaN or worse where E and A are. */
static PyObject *balance(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Series from[2];
    if (!begin(&call, given, count, 2))
        return NULL;
    if (!series(&call, 0, 4, &from[0]) || !series(&call, 1, 4, &from[1]))
        return failed(&call);
    PyArrayObject *E = (PyArrayObject *)given[0], *A = (PyArrayObject *)given[1];
    const npy_intp n = size(E, 2);
    if (!same("rows and columns of E", n, size(E, 3)) || !same("rows of E and A", n, size(A, 2)) ||
        !same("rows and columns of A", n, size(A, 3)))
        return failed(&call);
    PyArrayObject *rows = fresh(&call, 1, &n), *columns = rows ? fresh(&call, 1, &n) : NULL;
    PyArrayObject *time = columns ? fresh(&call, 1, (npy_intp[]){1}) : NULL;
    double *most = time ? scratch(&call, 2 * n * n) : NULL;
    if (most == NULL)
        return failed(&call);
    double *row = data(rows), *column = data(columns), tau = 1.0;
    memset(most, 0, 2 * n * n * sizeof(double));
    int some[2] = {0, 0};
    for (int which = 0; which < 2; which++) {
        double *to = most + which * n * n;
        if (from[which].orders < 1)
            continue;
        for (npy_intp t = 0; t < (from[which].time ? from[which].times : 1); t++) {
            const double *x = from[which].at + t * from[which].time;
            for (npy_intp i = 0; i < n * n; i++)
                to[i] = fabs(x[i]) <= to[i] ? to[i] : fabs(x[i]); /* NaN comes through */
        }
        for (npy_intp i = 0; i < n * n; i++)
            some[which] |= to[i] != 0.0;
    }
    for (npy_intp i = 0; i < n; i++)
        row[i] = column[i] = 1.0;
    for (int round = 0; round < 4; round++) {
        if (some[0] && some[1]) {
            double squares[2] = {0.0, 0.0};
            for (int which = 0; which < 2; which++)
                for (npy_intp i = 0; i < n * n; i++) {
                    const double x = row[i / n] * most[which * n * n + i] * column[i % n];
                    squares[which] += x * x;
                }
            tau = sqrt(squares[0] / squares[1]);
        }
        for (npy_intp i = 0; i < n; i++) {
            double largest = 0.0;
            for (npy_intp j = 0; j < n; j++) {
                const double x =
                    (most[i * n + j] / tau + most[n * n + i * n + j]) * column[j];
                largest = x <= largest ? largest : x;
            }
            row[i] = largest > 0.0 ? 1.0 / largest : 1.0;
        }
        for (npy_intp j = 0; j < n; j++) {
            double largest = 0.0;
            for (npy_intp i = 0; i < n; i++) {
                const double x = (most[i * n + j] / tau + most[n * n + i * n + j]) * row[i];
                largest = x <= largest ? largest : x;
            }
            column[j] = largest > 0.0 ? 1.0 / largest : 1.0;
        }
    }
    for (npy_intp i = 0; i < n; i++) {
        row[i] = power_of_two(row[i]);
        column[i] = power_of_two(column[i]);
    }
    data(time)[0] = power_of_two(tau);
    return results(&call, 3, rows, columns, time);
}

/* dips(values (N, 3), share, fall, most) -> steady (1,), found (M, 2): column and place of local
   minima below this share of their column's maximum, ends included, the deepest first and at most
   so many of each column; columns that are not finite have none. steady is whether no such
   minimum lies between the ends and no value falls below `fall` of its column's maximum. */
static PyObject *dips(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    double share, fall;
    npy_intp most;
    if (!begin(&call, given, count, 4))
        return NULL;
    PyArrayObject *values = doubles(&call, 0, 2);
    if (values == NULL || !same("columns of values", size(values, 1), 3) ||
        !number(&call, 1, &share) || !number(&call, 2, &fall) || !whole_number(&call, 3, &most))
        return failed(&call);
    const npy_intp times = size(values, 0);
    PyArrayObject *steady = fresh(&call, 1, (npy_intp[]){1});
    double *all = steady ? scratch(&call, 3 * times) : NULL;
    if (all == NULL)
        return failed(&call);
    double is_steady = 1.0;
    npy_intp counts[3] = {0, 0, 0};
    for (npy_intp column = 0; column < 3; column++) {
        const double *x = data(values) + column;
        double largest = -HUGE_VAL, *minima = all + column * times;
        int finite = 1;
        for (npy_intp t = 0; t < times; t++) {
            finite &= fabs(x[3 * t]) < HUGE_VAL;
            largest = x[3 * t] > largest ? x[3 * t] : largest;
        }
        for (npy_intp t = 0; finite && t < times; t++) {
            if (!(x[3 * t] >= fall * largest))
                is_steady = 0.0;
            if (!(x[3 * t] < share * largest) || (t > 0 && x[3 * t] > x[3 * (t - 1)]) ||
                (t + 1 < times && x[3 * t] > x[3 * (t + 1)]))
                continue;
            if (t > 0 && t + 1 < times)
                is_steady = 0.0;
            npy_intp k = counts[column]++;
            for (; k > 0 && x[3 * (npy_intp)minima[k - 1]] > x[3 * t]; k--)
                minima[k] = minima[k - 1];
            minima[k] = (double)t;
        }
        counts[column] = counts[column] < most ? counts[column] : most;
    }
    data(steady)[0] = is_steady;
    PyArrayObject *found = fresh(&call, 2, (npy_intp[]){counts[0] + counts[1] + counts[2], 2});
    if (found == NULL)
        return failed(&call);
    double *to = data(found);
    for (npy_intp column = 0; column < 3; column++)
        for (npy_intp k = 0; k < counts[column]; k++) {
            *to++ = (double)column;
            *to++ = all[column * times + k];
        }
    return results(&call, 2, steady, found);
}

/* x (columns,) with R x = right, R upper triangular and given as its transpose in the upper left
   of L (…, length) by rows. In place; 0 where a pivot is below `least` of the largest. */
static int solve_upper(const double *L, npy_intp columns, npy_intp length, double least, double *x)
{
    for (npy_intp k = columns - 1; k >= 0; k--) {
        const double pivot = L[k * length + k];
        if (!(fabs(pivot) > least * fabs(L[0])))
            return 0;
        for (npy_intp j = k + 1; j < columns; j++)
            x[k] -= L[j * length + k] * x[j];
        x[k] /= pivot;
    }
    return 1;
}

/* consistent(E (n, n), A2 (a, n), f2 (a,), x0 (n,), least, rounding) -> known (1,), x (n,) with
   A2 x = −f2 and least |E (x − x0)|; numbers that move by less than `rounding` of the largest stay
   what they were. Where a pivot is below `least` of the largest, known is 0. */
static PyObject *consistent(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    double least, rounding;
    if (!begin(&call, given, count, 6))
        return NULL;
    PyArrayObject *E = doubles(&call, 0, 2), *A2 = E ? doubles(&call, 1, 2) : NULL;
    PyArrayObject *f2 = A2 ? doubles(&call, 2, 1) : NULL, *x0 = f2 ? doubles(&call, 3, 1) : NULL;
    if (x0 == NULL || !number(&call, 4, &least) || !number(&call, 5, &rounding))
        return failed(&call);
    const npy_intp n = size(x0, 0), a = size(A2, 0), d = n - a;
    if (!same("columns of E", size(E, 1), n) || !same("rows of E", size(E, 0), n) ||
        !same("columns of A2", size(A2, 1), n) || !same("rows of A2 and f2", a, size(f2, 0)))
        return failed(&call);
    if (d < 0) {
        PyErr_SetString(PyExc_ValueError, "more constraints than states");
        return failed(&call);
    }
    PyArrayObject *known = zeros(&call, 1, (npy_intp[]){1});
    PyArrayObject *x = known ? zeros(&call, 1, &n) : NULL;
    PyArrayObject *order_of = x ? fresh_indices(&call, n) : NULL;
    double *W = order_of ? scratch(&call, 4 * n * n + 4 * n) : NULL;
    if (W == NULL)
        return failed(&call);
    double *mirrors = W + n * n, *kernel = mirrors + n * n, *image = kernel + n * n;
    double *y = image + n * n, *right = y + n, *step = right + n, *moved = step + n;
    npy_intp *order = (npy_intp *)PyArray_DATA(order_of);
    /* A2 = P L Qᵀ: of A2 δ = −(A2 x0 + f2) the shortest is Q₁ L⁻¹ Pᵀ of the right-hand side. */
    memcpy(W, data(A2), a * n * sizeof(double));
    triangularise(W, a, n, mirrors, order);
    for (npy_intp k = 0; k < a; k++) {
        const npy_intp i = order[k];
        y[k] = -data(f2)[i] - dot(data(A2) + i * n, data(x0), n);
        for (npy_intp j = 0; j < k; j++)
            y[k] -= W[k * n + j] * y[j];
        if (!(fabs(W[k * n + k]) > least * fabs(W[0])))
            return results(&call, 2, known, x);
        y[k] /= W[k * n + k];
    }
    memcpy(step, y, a * sizeof(double));
    memset(step + a, 0, d * sizeof(double));
    for (npy_intp k = a - 1; k >= 0; k--) {
        const double along = dot(mirrors + k * n, step, n);
        for (npy_intp i = 0; i < n; i++)
            step[i] -= along * mirrors[k * n + i];
    }
    /* In the kernel what keeps E δ short: the columns of E Q₂ are rows here, = L̃ Q̃ᵀ. */
    columns_of_q(mirrors, a, n, a, kernel);
    for (npy_intp i = 0; i < n; i++) {
        moved[i] = -dot(data(E) + i * n, step, n);
        for (npy_intp k = 0; k < d; k++)
            image[k * n + i] = dot(data(E) + i * n, kernel + k * n, n);
    }
    triangularise(image, d, n, mirrors, order);
    for (npy_intp k = 0; k < d; k++) {
        const double along = dot(mirrors + k * n, moved, n);
        for (npy_intp i = 0; i < n; i++)
            moved[i] -= along * mirrors[k * n + i];
    }
    if (!solve_upper(image, d, n, least, moved))
        return results(&call, 2, known, x);
    for (npy_intp i = 0; i < n; i++) {
        data(x)[i] = data(x0)[i] + step[i];
        for (npy_intp k = 0; k < d; k++)
            data(x)[i] += kernel[order[k] * n + i] * moved[k];
    }
    double largest = 0.0;
    for (npy_intp i = 0; i < n; i++) {
        largest = fabs(data(x)[i]) > largest ? fabs(data(x)[i]) : largest;
        largest = fabs(data(x0)[i]) > largest ? fabs(data(x0)[i]) : largest;
    }
    for (npy_intp i = 0; i < n; i++)
        if (fabs(data(x)[i] - data(x0)[i]) <= rounding * largest)
            data(x)[i] = data(x0)[i];
    data(known)[0] = 1.0;
    return results(&call, 2, known, x);
}

#define KERNEL(name) {#name, (PyCFunction)(void (*)(void))name, METH_FASTCALL, NULL}

PyMethodDef structure_kernels[] = {
    KERNEL(levels),  KERNEL(start), KERNEL(all_levels), KERNEL(reduced), KERNEL(reduced_constant),
    KERNEL(balance), KERNEL(dips),  KERNEL(consistent), {NULL, NULL, 0, NULL},
};
