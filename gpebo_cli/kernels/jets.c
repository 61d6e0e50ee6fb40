/* gpebo_cli/expressions: Taylor coefficients of all entries of a plant. */
#include "common.h"

#include <fenv.h>

#define MOST_MATRICES 8
#define MOST_AXES 8
#define GIVEN 2                 /* rows that the caller gives: t, inside */
#define REFUSED (FE_INVALID | FE_DIVBYZERO | FE_OVERFLOW)
#define IN_CACHE ((npy_intp)1 << 14) /* numbers in all rows of a block */

/* In the order of _OPERATIONS in expressions/program.py. */
enum {
    ADD, SUBTRACT, MULTIPLY, DIVIDE, POWER, GREATER_EQUAL, NEGATIVE, SQRT,
    EXP, LOG, SIN, COS, TAN, SINH, COSH, TANH, SIGN, OPERATIONS
};

/* One operation: what, the row of its result, its operands; see `operand`. */
typedef struct {
    npy_intp what, result, left, right;
} Operation;

/* The rows of one block of times. */
typedef struct {
    const double *given[GIVEN];
    double *memory; /* rows GIVEN, GIVEN + 1, … of `length` numbers each */
    npy_intp length;
    const double *constants;
} Rows;

static inline const double *row_of(const Rows *rows, npy_intp index)
{
    return index < GIVEN ? rows->given[index] : rows->memory + (index - GIVEN) * rows->length;
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

/* Does one operation for `count` times. */
static void operate(const Rows *rows, const Operation *operation, npy_intp count)
{
    const npy_intp left = operation->left, right = operation->right;
    double *restrict z = rows->memory + (operation->result - GIVEN) * rows->length;
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
    default: UNARY(x[i] > 0.0 ? 1.0 : x[i] < 0.0 ? -1.0 : x[i] == 0.0 ? 0.0 : x[i]);
    }
}

/* Sine and cosine of the same row: together they cost as much as one of them. */
static void sine_and_cosine(const Rows *rows, const Operation *sine, const Operation *cosine,
                            npy_intp count)
{
    const double *restrict x = row_of(rows, sine->left);
    double *restrict s = rows->memory + (sine->result - GIVEN) * rows->length;
    double *restrict c = rows->memory + (cosine->result - GIVEN) * rows->length;
    for (npy_intp i = 0; i < count; i++) {
        const double angle = x[i];
        s[i] = sin(angle);
        c[i] = cos(angle);
    }
}

static void run(const Rows *rows, const Operation *code, npy_intp operations, npy_intp count)
{
    for (npy_intp k = 0; k < operations; k++) {
        if (code[k].what == SIN && k + 1 < operations && code[k + 1].what == COS &&
            code[k + 1].left == code[k].left) {
            sine_and_cosine(rows, code + k, code + k + 1, count);
            k++;
        } else {
            operate(rows, code + k, count);
        }
    }
}

static int outside(const char *what, npy_intp value)
{
    PyErr_Format(PyExc_ValueError, "%s: no such one as %zd", what, (Py_ssize_t)value);
    return 0;
}

/* How many rows the operations use, those given included; 0 with an exception if they are none
   that can be run. */
static npy_intp rows_used(PyArrayObject *code, npy_intp constants)
{
    const Operation *operation = PyArray_DATA(code);
    npy_intp rows = GIVEN;
    for (npy_intp k = 0; k < size(code, 0); k++, operation++) {
        const npy_intp what = operation->what, left = operation->left, right = operation->right;
        if (what < 0 || what >= OPERATIONS)
            return outside("operations", what);
        if (operation->result < GIVEN || operation->result > rows)
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

/* jets(t (N,), inside (N,), code (operations, 4), constants (c,), results (orders, outputs),
        targets (outputs, 2), matrix (orders, 1, …), …)

   Matrices (orders, N, …): each as it is given, the same at all times, but for the entries that
   the targets (matrix, entry) name; those are the outputs of the code, see
   expressions/program.py, at each of the times. Matrices without targets are read-only with
   stride 0 in time. None if an operation was invalid, or an output is not finite. */
static PyObject *jets(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    enum { FIRST = 6 };
    Call call;
    const npy_intp matrices = count - FIRST;
    if (!begin(&call, given, count, matrices < 1 || matrices > MOST_MATRICES ? FIRST + 1 : count))
        return NULL;
    PyArrayObject *t = doubles(&call, 0, 1), *inside = t ? doubles(&call, 1, 1) : NULL;
    PyArrayObject *code = inside ? indices(&call, 2, 2) : NULL;
    PyArrayObject *constants = code ? doubles(&call, 3, 1) : NULL;
    PyArrayObject *rows_of_results = constants ? indices(&call, 4, 2) : NULL;
    PyArrayObject *targets = rows_of_results ? indices(&call, 5, 2) : NULL;
    if (targets == NULL || !same("times", size(t, 0), size(inside, 0)) ||
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
        const int axes = PyArray_Check(given[FIRST + m])
                             ? PyArray_NDIM((PyArrayObject *)given[FIRST + m])
                             : 0;
        once[m] = doubles(&call, FIRST + m, axes < 2 ? 2 : axes > MOST_AXES ? MOST_AXES : axes);
        if (once[m] == NULL || !same("orders of a matrix", size(once[m], 0), orders) ||
            !same("times in a matrix", size(once[m], 1), 1))
            return failed(&call);
    }
    int varies[MOST_MATRICES] = {0};
    const npy_intp used = rows_used(code, size(constants, 0));
    if (!used || !targets_fit(targets, once, matrices, varies))
        return failed(&call);
    const npy_intp *results_rows = PyArray_DATA(rows_of_results);
    for (npy_intp k = 0; k < orders * outputs; k++)
        if (results_rows[k] >= used || results_rows[k] < -size(constants, 0)) {
            outside("rows of results", results_rows[k]);
            return failed(&call);
        }

    npy_intp block = IN_CACHE / used;
    block = block < 32 ? 32 : block > 512 ? 512 : block;
    block = block > times ? times : block;
    Rows rows = {{NULL, NULL}, scratch(&call, (used - GIVEN) * block), block, data(constants)};
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
        run(&rows, PyArray_DATA(code), operations, here);
        const npy_intp *target = PyArray_DATA(targets);
        for (npy_intp j = 0; j < outputs; j++, target += 2) {
            const npy_intp entries = PyArray_SIZE(once[target[0]]) / orders;
            for (npy_intp k = 0; k < orders; k++)
                fine &= scatter(&rows, results_rows[k * outputs + j],
                                out[target[0]] + (k * times + first) * entries + target[1],
                                entries, here);
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

PyMethodDef jets_kernels[] = {
    {"jets", (PyCFunction)(void (*)(void))jets, METH_FASTCALL, NULL},
    {NULL, NULL, 0, NULL},
};
