/* gpebo_cli/simulation: derivative arrays, their ranks, scalings, consistent states. */
#include "structure.h"

#include "orthogonal.h"

/* ---- arguments --------------------------------------------------------------------------- */

int series(Call *call, Py_ssize_t place, int axes, Series *out)
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

int model(Call *call, Model *m)
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
    if (!same("columns and rows", size(columns, 0), m->n) || !same("rows of E", size(E, 2), m->n) ||
        !same("columns of E", size(E, 3), m->n) || !same("rows of A", size(A, 2), m->n) ||
        !same("columns of A", size(A, 3), m->n) ||
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

void scaled(const Model *m, npy_intp t, double *e, double *a)
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

int prepare(Call *call, const Model *m, Look *look)
{
    const npy_intp n = m->n, size = m->size, many = size * size;
    double *memory = old_scratch(call, 2 * n * size + 4 * many + size + size * size + 3 * n * n);
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

int look_at(const Model *m, npy_intp t, npy_intp constraints, double rank_tol, int upto, Look *look)
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
   rows, columns (size,), Z1 (n, d), dynamics (1, d, d) at one of the times, where to
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
    PyArrayObject *dynamics = Z1 ? fresh(&call, 3, (npy_intp[]){1, d, d}) : NULL;
    double *whole = dynamics ? old_scratch(&call, 2 * n * n) : NULL;
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
        dynamics_of(&m, &look, whole, data(dynamics));
        derivative_array(&m, look.e, look.a, look.M);
        seen = pivots(look.M, size, size - a, first, second);
        flagged_first(first, size, look.order);
        flagged_first(second, size, look.order);
    }
    data(known)[0] = seen;
    data(known)[1] = (double)look.constraints;
    return results(&call, 6, known, smallest, rows, columns, Z1, dynamics);
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
    double *all = steady ? old_scratch(&call, 3 * times) : NULL;
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

PyMethodDef structure_kernels[] = {
    KERNEL(levels), KERNEL(start), KERNEL(dips), {NULL, NULL, 0, NULL},
};
