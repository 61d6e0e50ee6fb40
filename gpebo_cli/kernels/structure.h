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

/* Arguments 0 to 5: E, A, rows, columns, time, orders used. */
#define MODEL "oN?nn oN?nn n n # %v "
static inline Outcome read_model(Call *call, Model *m)
{
    const npy_intp n = SIZE(n), v = SIZE(v);
    *m = (Model){.n = n, .orders = v, .size = v * n, .times = SIZE(N), .time = call->number[4]};
    m->E = series(call, 0, n * n), m->A = series(call, 1, n * n);
    m->rows = call->in[2], m->columns = call->in[3];
    if (n < 1 || v < 1 || SIZE(o) < v || SIZE(N) < 1)
        return refused("Taylor coefficients", SIZE(o));
    return DONE;
}

#endif
