/* A model as the kernels of the reduction see it; for structure.c and reduction.c. */
#ifndef GPEBO_STRUCTURE_H
#define GPEBO_STRUCTURE_H

#include "kernel.h"

/* Taylor coefficients (orders, times, …): numbers from one order and one time to the next. */
typedef struct {
    const double *at;
    npy_intp order, time, entries;
} Series;

/* E and A with the scalings of rows, states and time; size = orders n is that of M. */
typedef struct {
    Series E, A;
    const double *rows, *columns; /* (n,) */
    double time;
    npy_intp n, orders, size, times;
} Model;

static inline Series series(const Call *call, int place, npy_intp entries)
{
    return (Series){call->in[place], call->order[place], call->step[place], entries};
}

/* Arguments 0 to 5, "oN?nn oN?nn n n # %v": E, A, rows, columns, time, orders used. */
static inline Outcome read_model(Call *call, Model *m)
{
    const npy_intp n = SIZE(n), v = SIZE(v);
    *m = (Model){series(call, 0, n * n),
                 series(call, 1, n * n),
                 call->in[2],
                 call->in[3],
                 call->number[4],
                 n,
                 v,
                 v * n,
                 SIZE(N)};
    if (n < 1 || v < 1 || SIZE(o) < v || SIZE(N) < 1)
        return refused("Taylor coefficients", SIZE(o));
    return DONE;
}

#endif
