/* How kernels are described and called: arrays come in, new arrays go out, sizes go by letters. */
#ifndef GPEBO_KERNEL_H
#define GPEBO_KERNEL_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#define NPY_NO_DEPRECATED_API NPY_1_7_API_VERSION
#define PY_ARRAY_UNIQUE_SYMBOL gpebo_numpy_api
#ifndef GPEBO_MODULE
#define NO_IMPORT_ARRAY
#endif
#include <numpy/arrayobject.h>

#include <float.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

/* One version of a function for each width of the processor's registers, chosen when the module
   is loaded. All round alike: no loop adds up in another order, nothing is contracted. */
#if defined(__has_attribute) && defined(__x86_64__) && defined(__GLIBC__) && !defined(GPEBO_PLAIN)
#if __has_attribute(target_clones)
#define EVERY_WIDTH __attribute__((target_clones("avx512f", "avx2", "default")))
#endif
#endif
#ifndef EVERY_WIDTH
#define EVERY_WIDTH
#endif

/* A part of such a function: it has the width of the one that it stands in. */
#ifdef __GNUC__
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

#define MOST_ARGUMENTS 24
#define MOST_HELD 64

/* What a kernel returns: results, "let NumPy do it", or a Python exception. */
typedef enum { DONE, DECLINED, ERROR } Outcome;

/* Arguments of one call and results under way; the caller of the kernel gives all back. */
typedef struct {
    npy_intp size[128];                    /* of an axis, by its letter */
    const double *in[MOST_ARGUMENTS];      /* arrays of float64; NULL for None */
    const npy_intp *index[MOST_ARGUMENTS]; /* arrays of intp */
    double number[MOST_ARGUMENTS];
    npy_intp step[MOST_ARGUMENTS];  /* numbers from one time to the next, 0 for what is constant */
    npy_intp order[MOST_ARGUMENTS]; /* numbers from one Taylor coefficient to the next */
    double *out[MOST_ARGUMENTS];
    npy_intp *index_out[MOST_ARGUMENTS];
    PyArrayObject *array[MOST_ARGUMENTS]; /* the arguments themselves */
    Py_ssize_t count;                     /* how many there are */
    PyObject *answer;                     /* of a kernel that makes its results itself */
    PyObject *held[MOST_HELD];
    int used;
} Call;

/* `takes` has a word for each argument:

       Kst   an array of float64 with three axes, whose sizes get these letters
       K+    an axis that is one longer than K          3     an axis of that length
       N?    an axis of time, of length N, or 1 (or with stride 0) for what is constant
       @K    an array of intp                           |Kst  an array, or None
       #     a number                                   %c    a whole number ≥ 0, the size c
       *     any arrays of float64 from here on

   and may end with definitions, c=w-p. `gives` has a word for each result, @ as above; without
   it the kernel makes `answer` itself. */
typedef struct {
    const char *name, *takes, *gives;
    Outcome (*run)(Call *call);
} Kernel;

#define SIZE(letter) (call->size[(int)#letter[0]])

/* Memory for so many numbers or indices that lives as long as the call; NULL with an exception. */
double *scratch(Call *call, npy_intp numbers);

/* A ValueError about the arguments of a kernel. */
Outcome refused(const char *what, npy_intp value);

/* Keeps a new object until the call ends; NULL if it is NULL. */
PyObject *keep(Call *call, PyObject *made);

/* The larger one; what is not a number stays. */
static inline double larger(double a, double b) { return a >= b || a != a ? a : b; }

/* Rows a and b change places. */
static inline void swap_rows(double *restrict a, double *restrict b, npy_intp length)
{
    for (npy_intp j = 0; j < length; j++) {
        const double kept = a[j];
        a[j] = b[j];
        b[j] = kept;
    }
}

/* Adds all kernels to the module; −1 with an exception. */
int add_all_kernels(PyObject *module);

/* Each file of kernels has a table, which ends with an entry without a name. */
extern const Kernel law_kernels[], element_kernels[], signal_kernels[], structure_kernels[],
    reduction_kernels[], observer_kernels[], jet_kernels[], interval_kernels[];

#endif
