/* Known functions of time: gpebo_cli/model/expressions, their Taylor coefficients; simulation/simulate.py
   and Mesh.joined, the mesh that they ask for. */
#include "common.h"
#include "program.h"

#include <fenv.h>

#define MOST_MATRICES 12
#define MOST_AXES 8
#define REFUSED (FE_INVALID | FE_DIVBYZERO | FE_OVERFLOW)
#define IN_CACHE ((npy_intp)1 << 14) /* numbers in all rows of a block */

/* The rows of one block of times. */
typedef struct {
    const double *given[GIVEN];
    const double *signals; /* rows GIVEN, … of `stride` numbers each, up to row `first` */
    npy_intp stride, first;
    double *memory; /* the rows from `first` on, of `length` numbers each */
    npy_intp length;
    const double *constants;
} Rows;

static inline const double *row_of(const Rows *rows, npy_intp index)
{
    if (index >= rows->first)
        return rows->memory + (index - rows->first) * rows->length;
    return index < GIVEN ? rows->given[index] : rows->signals + (index - GIVEN) * rows->stride;
}

/* z = x `op` y over a block, where either operand may be a constant. */
#define BINARY(op)                                                                                 \
    do {                                                                                           \
        if (left < 0) {                                                                            \
            const double a = rows->constants[~left];                                               \
            const double *restrict y = row_of(rows, right);                                        \
            for (npy_intp i = 0; i < count; i++)                                                   \
                z[i] = a op y[i];                                                                  \
        } else if (right < 0) {                                                                    \
            const double b = rows->constants[~right];                                              \
            const double *restrict x = row_of(rows, left);                                         \
            for (npy_intp i = 0; i < count; i++)                                                   \
                z[i] = x[i] op b;                                                                  \
        } else {                                                                                   \
            const double *restrict x = row_of(rows, left);                                         \
            const double *restrict y = row_of(rows, right);                                        \
            for (npy_intp i = 0; i < count; i++)                                                   \
                z[i] = x[i] op y[i];                                                               \
        }                                                                                          \
    } while (0)

/* z = function(x) over a block. */
#define UNARY(value)                                                                               \
    do {                                                                                           \
        const double *restrict x = row_of(rows, left);                                             \
        for (npy_intp i = 0; i < count; i++)                                                       \
            z[i] = value;                                                                          \
    } while (0)

/* Does one operation for `count` times. The C library computes functions one value at a time;
   sines of several at once would be ten times faster, and ours to answer for. */
EVERY_WIDTH static void operate(const Rows *rows, const Operation *operation, npy_intp count)
{
    const npy_intp left = operation->left, right = operation->right;
    double *restrict z = rows->memory + (operation->result - rows->first) * rows->length;
    switch (operation->what) {
    case ADD: BINARY(+); break;
    case SUBTRACT: BINARY(-); break;
    case MULTIPLY: BINARY(*); break;
    case DIVIDE: BINARY(/); break;
    case POWER: UNARY(pow(x[i], rows->constants[~right])); break;
    case GREATER_EQUAL: UNARY(x[i] >= rows->constants[~right] ? 1.0 : 0.0); break;
    case NEGATIVE: UNARY(-x[i]); break;
    case SQRT: UNARY(sqrt(x[i])); break;
    case EXP: UNARY(exp(x[i])); break;
    case LOG: UNARY(log(x[i])); break;
    case SIN: UNARY(sin(x[i])); break;
    case COS: UNARY(cos(x[i])); break;
    case TAN: UNARY(tan(x[i])); break;
    case SINH: UNARY(sinh(x[i])); break;
    case COSH: UNARY(cosh(x[i])); break;
    case TANH: UNARY(tanh(x[i])); break;
    case ASIN: UNARY(asin(x[i])); break;
    case ACOS: UNARY(acos(x[i])); break;
    case ATAN: UNARY(atan(x[i])); break;
    case ASINH: UNARY(asinh(x[i])); break;
    case ACOSH: UNARY(acosh(x[i])); break;
    case ATANH: UNARY(atanh(x[i])); break;
    case ERF: UNARY(erf(x[i])); break;
    default: UNARY(x[i] > 0.0 ? 1.0 : x[i] < 0.0 ? -1.0 : x[i] == 0.0 ? 0.0 : x[i]);
    }
}

/* Does all operations for `count` times. */
static void run(const Rows *rows, const Operation *code, npy_intp operations, npy_intp count)
{
    for (npy_intp k = 0; k < operations; k++)
        operate(rows, code + k, count);
}

int outside(const char *what, npy_intp value)
{
    PyErr_Format(PyExc_ValueError, "%s: no such one as %zd", what, (Py_ssize_t)value);
    return 0;
}

npy_intp rows_used(PyArrayObject *code, npy_intp given, npy_intp constants)
{
    const Operation *operation = PyArray_DATA(code);
    npy_intp rows = given;
    for (npy_intp k = 0; k < size(code, 0); k++, operation++) {
        const npy_intp what = operation->what, left = operation->left, right = operation->right;
        if (what < 0 || what >= OPERATIONS)
            return outside("operations", what);
        if (operation->result < given || operation->result > rows)
            return outside("rows", operation->result);
        const int unary = what >= NEGATIVE, constant = what == POWER || what == GREATER_EQUAL;
        if (left >= rows || left < -constants || (left < 0 && (unary || constant || right < 0)))
            return outside("left operands", left);
        if (!unary && (right >= rows || right < -constants || (constant && right >= 0)))
            return outside("right operands", right);
        if (operation->result == left || (!unary && operation->result == right))
            return outside("rows to write to while they are read", left);
        if (operation->result == rows)
            rows++;
    }
    return rows;
}

int results_fit(PyArrayObject *results, npy_intp used, npy_intp constants)
{
    const npy_intp *row = PyArray_DATA(results);
    for (npy_intp k = 0; k < PyArray_SIZE(results); k++)
        if (row[k] >= used || row[k] < -constants)
            return outside("rows of results", row[k]);
    return 1;
}

/* An array (orders, 1, …) as one (orders, times, …) that cannot be written to: constant in time. */
static PyObject *repeated(PyArrayObject *once, npy_intp times)
{
    npy_intp shape[MOST_AXES], strides[MOST_AXES];
    const int axes = PyArray_NDIM(once);
    memcpy(shape, PyArray_DIMS(once), axes * sizeof(npy_intp));
    memcpy(strides, PyArray_STRIDES(once), axes * sizeof(npy_intp));
    shape[1] = times;
    strides[1] = 0;
    PyObject *view = PyArray_NewFromDescr(&PyArray_Type, PyArray_DescrFromType(NPY_DOUBLE), axes,
                                          shape, strides, PyArray_DATA(once), 0, NULL);
    if (view == NULL)
        return NULL;
    Py_INCREF((PyObject *)once);
    if (PyArray_SetBaseObject((PyArrayObject *)view, (PyObject *)once) < 0) {
        Py_DECREF(view);
        return NULL;
    }
    return view;
}

/* The same as an array of its own, to write into. */
static PyArrayObject *filled(Call *call, PyArrayObject *once, npy_intp times)
{
    npy_intp shape[MOST_AXES];
    const int axes = PyArray_NDIM(once);
    memcpy(shape, PyArray_DIMS(once), axes * sizeof(npy_intp));
    shape[1] = times;
    PyArrayObject *out = fresh(call, axes, shape);
    if (out == NULL)
        return NULL;
    const npy_intp orders = shape[0];
    const npy_intp entries = PyArray_SIZE(once) / orders;
    double *to = data(out);
    for (npy_intp k = 0; k < orders; k++) {
        const double *from = data(once) + k * entries;
        for (npy_intp i = 0; i < times; i++, to += entries)
            for (npy_intp j = 0; j < entries; j++)
                to[j] = from[j];
    }
    return out;
}

/* Whether `targets` (outputs, 2) name entries of the matrices, and marks those that vary. */
static int targets_fit(PyArrayObject *targets, PyArrayObject *const *once, npy_intp matrices,
                       int *varies)
{
    const npy_intp *target = PyArray_DATA(targets);
    for (npy_intp j = 0; j < size(targets, 0); j++, target += 2) {
        if (target[0] < 0 || target[0] >= matrices)
            return outside("matrices", target[0]);
        PyArrayObject *matrix = once[target[0]];
        if (target[1] < 0 || target[1] >= PyArray_SIZE(matrix) / size(matrix, 0))
            return outside("entries", target[1]);
        varies[target[0]] = 1;
    }
    return 1;
}

/* Where one coefficient of one output goes: every `stride` numbers, one for each time. */
static int scatter(const Rows *rows, npy_intp row, double *out, npy_intp stride, npy_intp count)
{
    int finite = 1;
    if (row < 0) {
        const double value = rows->constants[~row];
        for (npy_intp i = 0; i < count; i++)
            out[i * stride] = value;
        return isfinite(value);
    }
    const double *restrict x = row_of(rows, row);
    for (npy_intp i = 0; i < count; i++) {
        out[i * stride] = x[i];
        finite &= fabs(x[i]) <= 1.7976931348623157e308;
    }
    return finite;
}

/* jets(t (N,), inside (N,), signals (rows, N), code (operations, 4), constants (c,),
        results (orders, outputs), targets (outputs, 2), matrix (orders, 1, …), …)

   Matrices (orders, N, …): each as it is given, the same at all times, but for the entries that
   the targets (matrix, entry) name; those are the outputs of the code, see
   expressions/program.py, at each of the times. Matrices without targets are read-only with
   stride 0 in time. None if an operation was invalid, or an output is not finite. */
static PyObject *jets(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    enum { FIRST = 7 };
    Call call;
    const npy_intp matrices = count - FIRST;
    if (!begin(&call, given, count, matrices < 1 || matrices > MOST_MATRICES ? FIRST + 1 : count))
        return NULL;
    PyArrayObject *t = doubles(&call, 0, 1), *inside = t ? doubles(&call, 1, 1) : NULL;
    PyArrayObject *signals = inside ? doubles(&call, 2, 2) : NULL;
    PyArrayObject *code = signals ? indices(&call, 3, 2) : NULL;
    PyArrayObject *constants = code ? doubles(&call, 4, 1) : NULL;
    PyArrayObject *rows_of_results = constants ? indices(&call, 5, 2) : NULL;
    PyArrayObject *targets = rows_of_results ? indices(&call, 6, 2) : NULL;
    if (targets == NULL || !same("times", size(t, 0), size(inside, 0)) ||
        !same("times of signals", size(signals, 1), size(t, 0)) ||
        !same("numbers of an operation", size(code, 1), 4) ||
        !same("numbers of a target", size(targets, 1), 2) ||
        !same("outputs and targets", size(rows_of_results, 1), size(targets, 0)))
        return failed(&call);
    const npy_intp times = size(t, 0), orders = size(rows_of_results, 0);
    const npy_intp outputs = size(targets, 0), operations = size(code, 0);
    if (orders == 0) {
        outside("orders", 0);
        return failed(&call);
    }
    PyArrayObject *once[MOST_MATRICES];
    for (npy_intp m = 0; m < matrices; m++) {
        const int axes =
            PyArray_Check(given[FIRST + m]) ? PyArray_NDIM((PyArrayObject *)given[FIRST + m]) : 0;
        once[m] = doubles(&call, FIRST + m, axes < 2 ? 2 : axes > MOST_AXES ? MOST_AXES : axes);
        if (once[m] == NULL || !same("orders of a matrix", size(once[m], 0), orders) ||
            !same("times in a matrix", size(once[m], 1), 1))
            return failed(&call);
    }
    int varies[MOST_MATRICES] = {0};
    const npy_intp known = GIVEN + size(signals, 0);
    const npy_intp used = rows_used(code, known, size(constants, 0));
    if (!used || !results_fit(rows_of_results, used, size(constants, 0)) ||
        !targets_fit(targets, once, matrices, varies))
        return failed(&call);
    const npy_intp *results_rows = PyArray_DATA(rows_of_results);

    npy_intp block = IN_CACHE / used;
    block = block < 32 ? 32 : block > 512 ? 512 : block;
    block = block > times ? times : block;
    Rows rows = {
        {NULL, NULL}, NULL, times, known, old_scratch(&call, (used - known) * block), block,
        data(constants)};
    if (rows.memory == NULL)
        return failed(&call);
    double *out[MOST_MATRICES] = {NULL};
    PyObject *answer = PyTuple_New(matrices);
    for (npy_intp m = 0; answer != NULL && m < matrices; m++) {
        PyObject *matrix;
        if (varies[m]) {
            matrix = (PyObject *)filled(&call, once[m], times);
            Py_XINCREF(matrix);
            if (matrix != NULL)
                out[m] = data((PyArrayObject *)matrix);
        } else {
            matrix = repeated(once[m], times);
        }
        if (matrix == NULL)
            Py_CLEAR(answer);
        else
            PyTuple_SetItem(answer, m, matrix);
    }
    if (answer == NULL)
        return failed(&call);

    feclearexcept(REFUSED);
    int fine = 1;
    for (npy_intp first = 0; first < times; first += block) {
        const npy_intp here = times - first < block ? times - first : block;
        rows.given[0] = data(t) + first;
        rows.given[1] = data(inside) + first;
        rows.signals = data(signals) + first;
        run(&rows, PyArray_DATA(code), operations, here);
        const npy_intp *target = PyArray_DATA(targets);
        for (npy_intp j = 0; j < outputs; j++, target += 2) {
            const npy_intp entries = PyArray_SIZE(once[target[0]]) / orders;
            for (npy_intp k = 0; k < orders; k++)
                fine &= scatter(&rows, results_rows[k * outputs + j],
                                out[target[0]] + (k * times + first) * entries + target[1], entries,
                                here);
        }
    }
    if (fetestexcept(REFUSED)) {
        feclearexcept(REFUSED);
        fine = 0;
    }
    if (!fine) {
        Py_DECREF(answer);
        Py_INCREF(Py_None);
        answer = Py_None;
    }
    failed(&call); /* gives back what the call holds */
    return answer;
}

/* --- the mesh that known functions ask for --- */

#define REMEMBERED 16 /* columns with which the next ones are compared */

/* An argument as an array of float64 with at least two axes. */
static PyArrayObject *values_of(Call *call, Py_ssize_t place)
{
    PyObject *given = call->given[place];
    const int axes = PyArray_Check(given) ? PyArray_NDIM((PyArrayObject *)given) : 0;
    return doubles(call, place, axes < 2 ? 2 : axes);
}

/* The product of all axes but the first two. */
static npy_intp entries_of(PyArrayObject *values)
{
    npy_intp entries = 1;
    for (int axis = 2; axis < PyArray_NDIM(values); axis++)
        entries *= size(values, axis);
    return entries;
}

enum { LANES = 4 }; /* running largest numbers that do not wait for each other */

/* The largest |x| of some numbers, 0 of none. */
EVERY_WIDTH static double largest_size(const double *x, npy_intp count)
{
    double most[LANES] = {0.0};
    npy_intp i = 0;
    for (; i + LANES <= count; i += LANES)
        for (int l = 0; l < LANES; l++)
            most[l] = larger(fabs(x[i + l]), most[l]);
    for (; i < count; i++)
        most[0] = larger(fabs(x[i]), most[0]);
    return larger(larger(most[0], most[1]), larger(most[2], most[3]));
}

/* Copies a column, every `stride` numbers, and says its smallest and largest number. */
EVERY_WIDTH static void column(const double *from, npy_intp stride, npy_intp count, double *to,
                               double *low, double *high)
{
    double least[LANES] = {INFINITY, INFINITY, INFINITY, INFINITY}, most[LANES];
    for (npy_intp i = 0; i < count; i++)
        to[i] = from[i * stride];
    for (int l = 0; l < LANES; l++)
        most[l] = -INFINITY;
    npy_intp i = 0;
    for (; i + LANES <= count; i += LANES)
        for (int l = 0; l < LANES; l++) {
            least[l] = to[i + l] < least[l] ? to[i + l] : least[l];
            most[l] = larger(to[i + l], most[l]);
        }
    for (; i < count; i++) {
        least[0] = to[i] < least[0] ? to[i] : least[0];
        most[0] = larger(to[i], most[0]);
    }
    *low = least[0];
    *high = most[0];
    for (int l = 1; l < LANES; l++) {
        *low = least[l] < *low ? least[l] : *low;
        *high = larger(most[l], *high);
    }
}

/* moved (entries,) becomes 1 where an entry of values (times, entries) is not one number
   throughout; row by row, because a column of a large matrix is spread over as many cache lines
   as there are times. */
EVERY_WIDTH static void mark_moved(npy_int64 *restrict moved, const double *restrict values,
                                   npy_intp times, npy_intp entries)
{
    for (npy_intp i = 1; i < times; i++)
        for (npy_intp e = 0; e < entries; e++)
            moved[e] |= values[i * entries + e] != values[e];
}

/* Memory for as many marks, all 0; NULL with an exception. */
static npy_int64 *marks(Call *call, npy_intp count)
{
    npy_int64 *made = (npy_int64 *)old_scratch(call, count);
    if (made != NULL)
        memset(made, 0, count * sizeof *made);
    return made;
}

/* out[j] = Σ_i weights[i] matrix[i, j]; matrix (inner, columns). */
static inline void combine(double *restrict out, const double *restrict matrix,
                           const double *restrict weights, npy_intp inner, npy_intp columns)
{
    for (npy_intp j = 0; j < columns; j++)
        out[j] = 0.0;
    npy_intp i = 0;
    for (; i + 4 <= inner; i += 4) {
        const double *restrict m = matrix + i * columns, *restrict w = weights + i;
        for (npy_intp j = 0; j < columns; j++)
            out[j] += (w[0] * m[j] + w[1] * m[columns + j]) +
                      (w[2] * m[2 * columns + j] + w[3] * m[3 * columns + j]);
    }
    for (; i < inner; i++)
        for (npy_intp j = 0; j < columns; j++)
            out[j] += weights[i] * matrix[i * columns + j];
}

/* Raises `missed` (elements,) to how far each element's polynomial is from the values `seen`
   (elements, looks) in between, relative to `largest`; nodal (elements, points). */
EVERY_WIDTH static void raise_missed(double *missed, const double *between, const double *nodal,
                                     const double *seen, double largest, npy_intp elements,
                                     npy_intp points, npy_intp looks, double *expected)
{
    for (npy_intp k = 0; k < elements; k++, nodal += points, seen += looks) {
        combine(expected, between, nodal, points, looks);
        for (npy_intp l = 0; l < looks; l++)
            expected[l] -= seen[l];
        missed[k] = larger(largest_size(expected, looks) / largest, missed[k]);
    }
}

/* missed_between(between (points, looks), nodal (·, elements * points, …),
                  seen (·, elements * looks, …), nodal, seen, …)

   For each pair, shape (pairs, elements): how far what is seen between the nodes is from the
   polynomial through the nodes, relative to the largest value of that entry; of the entries that
   move at all the largest. Of the first axes only the first member counts. */
static PyObject *missed_between(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    const npy_intp pairs = (count - 1) / 2;
    if (!begin(&call, given, count, pairs < 1 || pairs > MOST_MATRICES ? 3 : 1 + 2 * pairs))
        return NULL;
    PyArrayObject *between = doubles(&call, 0, 2), *out = NULL;
    if (between == NULL)
        return failed(&call);
    const npy_intp points = size(between, 0), looks = size(between, 1);
    double *memory = NULL, *expected = old_scratch(&call, looks);
    npy_intp elements = 0, length = 0;
    for (npy_intp pair = 0; expected != NULL && pair < pairs; pair++) {
        PyArrayObject *nodal = values_of(&call, 1 + 2 * pair);
        PyArrayObject *seen = nodal ? values_of(&call, 2 + 2 * pair) : NULL;
        if (seen == NULL)
            return failed(&call);
        if (pair == 0) {
            elements = points ? size(nodal, 1) / points : 0;
            length = elements * (points + looks);
            out = zeros(&call, 2, (npy_intp[]){pairs, elements});
            memory = out ? old_scratch(&call, REMEMBERED * length) : NULL;
        }
        const npy_intp entries = entries_of(nodal);
        if (memory == NULL || !same("nodes", size(nodal, 1), elements * points) ||
            !same("looks", size(seen, 1), elements * looks) ||
            !same("entries", entries, entries_of(seen)) ||
            (entries && (!size(nodal, 0) || !size(seen, 0)) && !outside("orders", 0)))
            return failed(&call);
        npy_int64 *moved = marks(&call, entries);
        if (moved == NULL)
            return failed(&call);
        mark_moved(moved, data(nodal), elements * points, entries);
        mark_moved(moved, data(seen), elements * looks, entries);
        npy_intp different = 0;
        for (npy_intp e = 0; e < entries; e++) {
            if (!moved[e])
                continue;
            double *here = memory + different % REMEMBERED * length;
            double low, high, least, most;
            column(data(nodal) + e, entries, elements * points, here, &low, &high);
            column(data(seen) + e, entries, elements * looks, here + elements * points, &least,
                   &most);
            npy_intp known = different < REMEMBERED ? different : REMEMBERED;
            while (known && (memory + (known - 1) * length == here ||
                             memcmp(memory + (known - 1) * length, here, length * sizeof(double))))
                known--;
            if (known)
                continue;
            different++;
            const double largest =
                larger(larger(fabs(low), fabs(high)), larger(fabs(least), fabs(most)));
            raise_missed(data(out) + pair * elements, data(between), here, here + elements * points,
                         largest, elements, points, looks, expected);
        }
    }
    return expected == NULL ? failed(&call) : results(&call, 1, out);
}

PyMethodDef jets_kernels[] = {
    KERNEL(jets), KERNEL(missed_between), {NULL, NULL, 0, NULL},
};
