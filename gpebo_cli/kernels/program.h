/* Operations on rows, recorded by gpebo_cli/model/expressions/program.py. */
#ifndef GPEBO_PROGRAM_H
#define GPEBO_PROGRAM_H

#include "kernel.h"

#define GIVEN 2 /* rows that are always given: t, inside; those of signals follow */

/* In the order of _OPERATIONS in expressions/program.py. */
enum { ADD, SUBTRACT, MULTIPLY, DIVIDE, MAXIMUM, POWER, GREATER_EQUAL, BINARY_OPERATIONS };
enum { NEGATIVE = BINARY_OPERATIONS, SQRT, EXP, LOG, SIN, COS, TAN, SINH, COSH, TANH, ASIN };
enum { ACOS = ASIN + 1, ATAN, ASINH, ACOSH, ATANH, ERF, ABSOLUTE, SIGN, OPERATIONS };

/* One operation: what, and its operands, rows or constants as ~index; it makes the next row. */
typedef struct {
    npy_intp what, left, right;
} Operation;

/* How many rows there are with those given; 0 with an exception if the operations are none that
   can be run. */
npy_intp rows_used(const Operation *operation, npy_intp count, npy_intp given, npy_intp constants);

/* Whether results (count,) are rows or constants that there are. */
int results_fit(const npy_intp *row, npy_intp count, npy_intp used, npy_intp constants);

/* An exception: there is no such thing as `value`; 0. */
static inline int no_such(const char *what, npy_intp value) { return refused(what, value) == DONE; }

#endif
