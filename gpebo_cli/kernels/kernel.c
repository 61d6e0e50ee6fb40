/* Checks the arguments of a kernel against its description, calls it, and packs its results. */
#include "kernel.h"

PyObject *keep(Call *call, PyObject *made)
{
    if (made == NULL)
        return NULL;
    if (call->used == MOST_HELD) {
        Py_DECREF(made);
        PyErr_SetString(PyExc_SystemError, "a kernel holds too many arrays");
        return NULL;
    }
    return call->held[call->used++] = made;
}

double *scratch(Call *call, npy_intp numbers)
{
    npy_intp length = numbers > 0 ? numbers : 1;
    PyObject *memory = keep(call, PyArray_SimpleNew(1, &length, NPY_DOUBLE));
    return memory == NULL ? NULL : PyArray_DATA((PyArrayObject *)memory);
}

Outcome refused(const char *what, npy_intp value)
{
    PyErr_Format(PyExc_ValueError, "%s: %zd will not do", what, (Py_ssize_t)value);
    return ERROR;
}

static int wrong_size(int place, char letter, npy_intp found, npy_intp wanted)
{
    PyErr_Format(PyExc_ValueError, "argument %d: %c is %zd, expected %zd", place, letter,
                 (Py_ssize_t)found, (Py_ssize_t)wanted);
    return 0;
}

/* One axis of a description: its letter (or 0), what it is longer by, or the length itself. */
typedef struct {
    char letter;
    int extra, may_be_one;
    npy_intp length;
} Axis;

/* The next axis of a word, or 0 at its end. */
static int next_axis(const char **word, Axis *axis)
{
    const char c = **word;
    if (c == 0 || c == ' ')
        return 0;
    *axis = (Axis){c, 0, 0, 0};
    if (c >= '0' && c <= '9') {
        axis->letter = 0;
        axis->length = c - '0';
    }
    for (++*word; **word == '+' || **word == '?'; ++*word) {
        axis->extra += **word == '+';
        axis->may_be_one |= **word == '?';
    }
    return 1;
}

/* Binds or compares the sizes of an argument; times that may be one are looked at `later`. */
static int bind_sizes(Call *call, int place, const char *word, int later)
{
    PyArrayObject *array = call->array[place];
    Axis axis;
    for (int i = 0; next_axis(&word, &axis); i++) {
        const npy_intp found = PyArray_DIM(array, i);
        npy_intp *size = &call->size[(int)axis.letter];
        if (axis.may_be_one != later)
            continue;
        if (axis.letter == 0) {
            if (found != axis.length)
                return wrong_size(place, 'n', found, axis.length);
        } else if (later && found == 1) {
            if (*size < 0)
                *size = 1;
        } else if (*size < 0 || (later && *size == 1)) {
            *size = found - axis.extra;
        } else if (found != *size + axis.extra) {
            return wrong_size(place, axis.letter, found, *size + axis.extra);
        }
        if (axis.letter && *size < 0)
            return wrong_size(place, axis.letter, *size, 0);
    }
    return 1;
}

/* The array as it stands if its axes after the one of time (or all) lie one number behind the
   other, else a copy that does. */
static PyArrayObject *laid_out(Call *call, PyArrayObject *given, int type, int time)
{
    const int axes = PyArray_NDIM(given);
    int usable = PyArray_ISBEHAVED_RO(given);
    npy_intp step = PyArray_ITEMSIZE(given);
    for (int axis = axes - 1; usable && axis > time; axis--) {
        usable = PyArray_DIM(given, axis) <= 1 || PyArray_STRIDE(given, axis) == step;
        step *= PyArray_DIM(given, axis);
    }
    if (usable)
        return given;
    return (PyArrayObject *)keep(call,
                                 PyArray_FROM_OTF((PyObject *)given, type, NPY_ARRAY_CARRAY_RO));
}

/* One argument that is an array, as `word` describes it. */
static int array_argument(Call *call, int place, PyObject *given, const char *word, int type)
{
    int axes = 0, time = -1;
    const char *rest = word;
    Axis axis;
    for (; next_axis(&rest, &axis); axes++)
        time = axis.may_be_one ? axes : time;
    PyArrayObject *array = (PyArrayObject *)given;
    if (!PyArray_Check(given) || PyArray_NDIM(array) != axes || PyArray_TYPE(array) != type) {
        PyErr_Format(PyExc_TypeError, "argument %d must be an array of %s with %d axes", place,
                     type == NPY_DOUBLE ? "float64" : "intp", axes);
        return 0;
    }
    array = laid_out(call, array, type, time);
    if (array == NULL)
        return 0;
    call->array[place] = array;
    if (type == NPY_INTP)
        call->index[place] = PyArray_DATA(array);
    else
        call->in[place] = PyArray_DATA(array);
    if (time >= 0) {
        const npy_intp item = sizeof(double);
        call->step[place] = PyArray_DIM(array, time) == 1 ? 0 : PyArray_STRIDE(array, time) / item;
        call->order[place] = PyArray_STRIDE(array, 0) / item;
    }
    return bind_sizes(call, place, word, 0);
}

/* A size that follows from others, c=w-p. */
static int define(Call *call, const char *word)
{
    const npy_intp left = call->size[(int)word[2]], right = call->size[(int)word[4]];
    const npy_intp value = word[3] == '+'   ? left + right
                           : word[3] == '-' ? left - right
                                            : left * right;
    npy_intp *size = &call->size[(int)word[0]];
    if (value < 0 || (*size >= 0 && *size != value))
        return wrong_size(0, word[0], *size, value);
    *size = value;
    return 1;
}

static int one_argument(Call *call, int place, PyObject *given, const char *word)
{
    if (*word == '#') {
        call->number[place] = PyFloat_AsDouble(given);
        return PyErr_Occurred() == NULL;
    }
    if (*word == '%') {
        call->size[(int)word[1]] = PyLong_AsSsize_t(given);
        if (PyErr_Occurred())
            return 0;
        return call->size[(int)word[1]] >= 0 || refused("a size", -1) == DONE;
    }
    if (*word == '|' && given == Py_None)
        return 1;
    word += *word == '|';
    return *word == '@' ? array_argument(call, place, given, word + 1, NPY_INTP)
                        : array_argument(call, place, given, word, NPY_DOUBLE);
}

static const char *after(const char *word)
{
    while (*word && *word != ' ')
        word++;
    return *word ? word + 1 : word;
}

/* The arrays of a kernel that takes any number of them, whatever their axes. */
static int any_arrays(Call *call, int place, PyObject *const *given)
{
    for (; place < call->count; place++) {
        PyArrayObject *array = (PyArrayObject *)given[place];
        if (!PyArray_Check(given[place]) || PyArray_TYPE(array) != NPY_DOUBLE ||
            PyArray_NDIM(array) < 2) {
            PyErr_Format(PyExc_TypeError, "argument %d must be an array of float64", place);
            return 0;
        }
        if ((array = laid_out(call, array, NPY_DOUBLE, -1)) == NULL)
            return 0;
        call->array[place] = array;
        call->in[place] = PyArray_DATA(array);
    }
    return 1;
}

/* Reads all arguments; 0 with an exception. */
static int read_arguments(Call *call, const char *takes, PyObject *const *given, Py_ssize_t count)
{
    int place = 0;
    for (const char *word = takes; *word; word = after(word)) {
        if (*word == '*') {
            const int fit = count > place && count <= MOST_ARGUMENTS;
            if (fit && !any_arrays(call, place, given))
                return 0;
            place = fit ? (int)count : place + 1;
            continue;
        }
        if (word[0] && word[1] == '=')
            break;
        if (place < count && !one_argument(call, place, given[place], word))
            return 0;
        place++;
    }
    if (place != count) {
        PyErr_Format(PyExc_TypeError, "%zd arguments, expected %d", count, place);
        return 0;
    }
    place = 0;
    for (const char *word = takes; *word; word = after(word), place++) {
        if (word[0] && word[1] == '=') {
            if (!define(call, word))
                return 0;
        } else if (place < count && call->array[place] != NULL && *word != '*') {
            const char *axes = word + (*word == '|');
            axes += *axes == '@';
            if (!bind_sizes(call, place, axes, 1))
                return 0;
        }
    }
    return 1;
}

/* New arrays for the results; how many, or −1 with an exception. */
static int make_results(Call *call, const char *gives, PyObject **results)
{
    int made = 0;
    for (const char *word = gives; *word; word = after(word), made++) {
        npy_intp shape[8];
        int axes = 0;
        const int whole = *word == '@';
        const char *rest = word + whole;
        Axis axis;
        for (; next_axis(&rest, &axis); axes++)
            shape[axes] = axis.letter ? call->size[(int)axis.letter] + axis.extra : axis.length;
        PyObject *array = keep(call, PyArray_SimpleNew(axes, shape, whole ? NPY_INTP : NPY_DOUBLE));
        if (array == NULL)
            return -1;
        results[made] = array;
        call->out[made] = PyArray_DATA((PyArrayObject *)array);
        call->index_out[made] = PyArray_DATA((PyArrayObject *)array);
    }
    return made;
}

static PyObject *packed(PyObject **results, int count)
{
    if (count == 1)
        return Py_NewRef(results[0]);
    PyObject *answer = PyTuple_New(count);
    for (int i = 0; answer != NULL && i < count; i++)
        PyTuple_SetItem(answer, i, Py_NewRef(results[i]));
    return answer;
}

static PyObject *run_kernel(PyObject *self, PyObject *const *given, Py_ssize_t count)
{
    const Kernel *kernel = PyCapsule_GetPointer(self, NULL);
    if (kernel == NULL)
        return NULL;
    Call call = {.count = count};
    PyObject *results[MOST_ARGUMENTS], *answer = NULL;
    for (int i = 0; i < 128; i++)
        call.size[i] = -1;
    int made = 0;
    Outcome outcome = ERROR;
    if (read_arguments(&call, kernel->takes, given, count)) {
        made = kernel->gives == NULL ? 0 : make_results(&call, kernel->gives, results);
        if (made >= 0)
            outcome = kernel->run(&call);
    }
    if (outcome == DECLINED)
        answer = Py_NewRef(Py_None);
    else if (outcome == DONE)
        answer = kernel->gives == NULL ? call.answer : packed(results, made);
    while (call.used)
        Py_DECREF(call.held[--call.used]);
    return answer;
}

static int add_kernels(PyObject *module, const Kernel *kernels)
{
    for (; kernels->name != NULL; kernels++) {
        PyMethodDef *method = PyMem_Malloc(sizeof(PyMethodDef)); /* lives as long as the process */
        PyObject *self = PyCapsule_New((void *)kernels, NULL, NULL);
        if (method == NULL || self == NULL)
            return -1;
        *method = (PyMethodDef){kernels->name, (PyCFunction)(void (*)(void))run_kernel,
                                METH_FASTCALL, NULL};
        PyObject *function = PyCFunction_NewEx(method, self, NULL);
        Py_DECREF(self);
        if (function == NULL || PyModule_AddObjectRef(module, kernels->name, function) < 0)
            return -1;
        Py_DECREF(function);
    }
    return 0;
}

int add_all_kernels(PyObject *module)
{
    const Kernel *tables[] = {law_kernels,       element_kernels,   signal_kernels,
                              structure_kernels, reduction_kernels, observer_kernels,
                              jet_kernels,       interval_kernels};
    for (size_t i = 0; i < sizeof(tables) / sizeof(tables[0]); i++)
        if (add_kernels(module, tables[i]) < 0)
            return -1;
    return 0;
}
