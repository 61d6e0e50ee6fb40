/* Known functions of time: their Taylor coefficients; see expressions_numpy.py. */
#include "program.h"

#include <fenv.h>

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

/* z = a value of p and q over a block, where either operand may be a constant. */
#define OF_BOTH(first, second, value)                                                              \
    for (npy_intp i = 0; i < count; i++) {                                                         \
        const double p = first, q = second;                                                        \
        z[i] = value;                                                                              \
    }
#define BINARY(value)                                                                              \
    do {                                                                                           \
        if (left < 0) {                                                                            \
            const double a = rows->constants[~left];                                               \
            const double *restrict y = row_of(rows, right);                                        \
            OF_BOTH(a, y[i], value)                                                                \
        } else if (right < 0) {                                                                    \
            const double b = rows->constants[~right];                                              \
            const double *restrict x = row_of(rows, left);                                         \
            OF_BOTH(x[i], b, value)                                                                \
        } else {                                                                                   \
            const double *restrict x = row_of(rows, left);                                         \
            const double *restrict y = row_of(rows, right);                                        \
            OF_BOTH(x[i], y[i], value)                                                             \
        }                                                                                          \
    } while (0)

/* z = function(x) over a block. */
#define UNARY(value)                                                                               \
    do {                                                                                           \
        const double *restrict x = row_of(rows, left);                                             \
        for (npy_intp i = 0; i < count; i++)                                                       \
            z[i] = value;                                                                          \
    } while (0)

/* Does one operation for `count` times, into z. The C library computes functions one value at a
   time; sines of several at once would be ten times faster, and ours to answer for. */
EVERY_WIDTH static void operate(const Rows *rows, const Operation *operation, double *restrict z,
                                npy_intp count)
{
    const npy_intp left = operation->left, right = operation->right;
    switch (operation->what) {
    case ADD: BINARY(p + q); break;
    case SUBTRACT: BINARY(p - q); break;
    case MULTIPLY: BINARY(p * q); break;
    case DIVIDE: BINARY(p / q); break;
    case MAXIMUM: BINARY(p > q ? p : q); break;
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
    case ABSOLUTE: UNARY(fabs(x[i])); break;
    default: UNARY(x[i] > 0.0 ? 1.0 : x[i] < 0.0 ? -1.0 : x[i] == 0.0 ? 0.0 : x[i]);
    }
}

npy_intp rows_used(const Operation *operation, npy_intp count, npy_intp given, npy_intp constants)
{
    npy_intp rows = given;
    for (; rows < given + count; rows++, operation++) {
        const npy_intp what = operation->what, left = operation->left, right = operation->right;
        if (what < 0 || what >= OPERATIONS)
            return no_such("operations", what);
        const int unary = what >= NEGATIVE, constant = what == POWER || what == GREATER_EQUAL;
        if (left >= rows || left < -constants || (left < 0 && (unary || constant || right < 0)))
            return no_such("left operands", left);
        if (!unary && (right >= rows || right < -constants || (constant && right >= 0)))
            return no_such("right operands", right);
    }
    return rows;
}

int results_fit(const npy_intp *row, npy_intp count, npy_intp used, npy_intp constants)
{
    for (npy_intp k = 0; k < count; k++)
        if (row[k] >= used || row[k] < -constants)
            return no_such("rows of results", row[k]);
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
    if (view != NULL &&
        PyArray_SetBaseObject((PyArrayObject *)view, Py_NewRef((PyObject *)once)) < 0)
        Py_CLEAR(view);
    return view;
}

enum { FIRST = 7 }; /* argument that is a matrix */

/* Whether the matrices and the targets in them fit; marks those that vary. */
static int targets_fit(const Call *call, int *varies)
{
    const npy_intp matrices = call->count - FIRST, *target = call->index[6];
    for (npy_intp m = 0; m < matrices; m++) {
        PyArrayObject *matrix = call->array[FIRST + m];
        if (PyArray_NDIM(matrix) > MOST_AXES || PyArray_DIM(matrix, 0) != SIZE(o) ||
            PyArray_DIM(matrix, 1) != 1)
            return no_such("orders or times in a matrix", PyArray_DIM(matrix, 0)), 0;
    }
    for (npy_intp k = 0; k < SIZE(j); k++, target += 2) {
        if (target[0] < 0 || target[0] >= matrices)
            return no_such("matrices", target[0]), 0;
        const npy_intp entries = PyArray_SIZE(call->array[FIRST + target[0]]) / SIZE(o);
        if (target[1] < 0 || target[1] >= entries)
            return no_such("entries", target[1]), 0;
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

/* The results, a tuple of matrices, and where those that vary begin; NULL with an exception. */
static PyObject *make_matrices(const Call *call, const int *varies, double **out)
{
    const npy_intp matrices = call->count - FIRST;
    PyObject *answer = PyTuple_New(matrices);
    for (npy_intp m = 0; answer != NULL && m < matrices; m++) {
        PyArrayObject *once = call->array[FIRST + m];
        PyObject *view = repeated(once, SIZE(N)), *matrix = view;
        if (view != NULL && varies[m]) { /* then it is written into */
            matrix = PyArray_NewCopy((PyArrayObject *)view, NPY_CORDER);
            Py_DECREF(view);
        }
        if (matrix == NULL) {
            Py_DECREF(answer);
            return NULL;
        }
        out[m] = PyArray_DATA((PyArrayObject *)matrix);
        PyTuple_SetItem(answer, m, matrix);
    }
    return answer;
}

/* Runs the program at all times, block by block, into the matrices; whether nothing has to be
   refused. */
static int fill_matrices(const Call *call, Rows *rows, double *const *out)
{
    const npy_intp times = SIZE(N), orders = SIZE(o), outputs = SIZE(j);
    int fine = 1;
    feclearexcept(REFUSED);
    for (npy_intp first = 0; first < times; first += rows->length) {
        const npy_intp here = times - first < rows->length ? times - first : rows->length;
        rows->given[0] = call->in[0] + first;
        rows->given[1] = call->in[1] + first;
        rows->signals = call->in[2] + first;
        for (npy_intp k = 0; k < SIZE(v); k++)
            operate(rows, (const Operation *)call->index[3] + k, rows->memory + k * rows->length,
                    here);
        const npy_intp *target = call->index[6];
        for (npy_intp j = 0; j < outputs; j++, target += 2) {
            const npy_intp entries = PyArray_SIZE(call->array[FIRST + target[0]]) / orders;
            for (npy_intp k = 0; k < orders; k++)
                fine &= scatter(rows, call->index[5][k * outputs + j],
                                out[target[0]] + (k * times + first) * entries + target[1], entries,
                                here);
        }
    }
    fine &= !fetestexcept(REFUSED);
    feclearexcept(REFUSED);
    return fine;
}

/* t, inside, signals, code, constants, rows of the results, targets, matrices … -> matrices. */
static Outcome jets(Call *call)
{
    int varies[MOST_ARGUMENTS] = {0};
    double *out[MOST_ARGUMENTS] = {NULL};
    if (SIZE(o) < 1)
        return refused("orders", SIZE(o));
    const npy_intp known = GIVEN + SIZE(x), constants = SIZE(c);
    const npy_intp used = rows_used((const Operation *)call->index[3], SIZE(v), known, constants);
    if (!used || !results_fit(call->index[5], SIZE(o) * SIZE(j), used, constants) ||
        !targets_fit(call, varies))
        return ERROR;
    npy_intp block = IN_CACHE / used;
    block = block < 16 ? 16 : block > 512 ? 512 : block;
    block = block > SIZE(N) ? SIZE(N) : block;
    Rows rows = {{NULL, NULL}, NULL,       SIZE(N), known, scratch(call, (used - known) * block),
                 block,        call->in[4]};
    if (rows.memory == NULL || (call->answer = make_matrices(call, varies, out)) == NULL)
        return ERROR;
    if (fill_matrices(call, &rows, out))
        return DONE;
    Py_CLEAR(call->answer);
    return DECLINED;
}

const Kernel jet_kernels[] = {
    {"jets", "N N xN @v3 c @oj @j2 *", NULL, jets},
    {NULL, NULL, NULL, NULL},
};
