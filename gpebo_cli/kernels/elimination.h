/* Dense systems of some tens of unknowns. */
#ifndef GPEBO_ELIMINATION_H
#define GPEBO_ELIMINATION_H

#include "common.h"

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

/* Right-hand sides are solved for this many at once; their number is rounded up to a multiple. */
#define SIDES 8

/* Length of the rows of [A | B] for A (m, m) and B (m, columns). */
static inline npy_intp row_length(npy_intp m, npy_intp columns)
{
    return m + (columns + SIDES - 1) / SIDES * SIDES;
}

/* Solves A X = B by elimination with row pivoting. W holds [A | B | 0] in m rows of
   row_length(m, columns) numbers; A is destroyed and B becomes X. 0 if a pivot is exactly zero. */
int eliminate(double *W, npy_intp m, npy_intp columns);

#endif
