/* How well a mesh resolves signals, sampling; see signals_numpy.py. */
#include "elements.h"

/* Values of one kind, to_legendre, `used`, foot, share, floor, least sizes or None -> the largest of
   the last coefficients of each element, relative to the components' sizes so far, to the power
   that makes of degree j one of the degree `points`. Components that are smaller than `least` (c,),
   if there is one, count as that large, and all are compared in these units. */
EVERY_WIDTH static Outcome tails(Call *call)
{
    const npy_intp K = SIZE(K), points = SIZE(t), c = SIZE(c), used = SIZE(u);
    const double *least = call->in[6], floor = larger(call->number[5], DBL_MIN);
    const double *to_legendre = call->in[1] + (points - used) * points;
    if (used >= points)
        return refused("Legendre coefficients", used);
    double *work = scratch(call, (K + 3 + used) * c), *tail = call->out[0];
    if (work == NULL)
        return ERROR;
    double *scale = work + (K + 1) * c, *unit = scale + c, *last = unit + c;
    memset(work, 0, c * sizeof(double));
    memset(tail, 0, K * sizeof(double));
    for (npy_intp k = 0; k < K; k++) { /* largest value of each component so far */
        memcpy(work + (k + 1) * c, work + k * c, c * sizeof(double));
        enlarge(work + (k + 1) * c, call->in[0] + k * points * c, points, c);
    }
    const double *final = work + K * c;
    for (npy_intp b = 0; b < c; b++)
        unit[b] = least ? larger(larger(final[b], least[b]), DBL_MIN) : 1.0;
    for (npy_intp k = 0; k < K && c > 0; k++) {
        for (npy_intp b = 0; b < c; b++) {
            const int small = least && final[b] < unit[b];
            const double so_far = larger(work[(k + 1) * c + b], call->number[3] * final[b]);
            scale[b] = small ? 1.0 : so_far / unit[b];
        }
        const double level = larger(call->number[4] * largest_of(0.0, scale, c), floor);
        for (npy_intp b = 0; b < c; b++)
            scale[b] = larger(scale[b], level) * unit[b];
        last_coefficients(last, to_legendre, call->in[0] + k * points * c, used, points, c);
        for (npy_intp j = 0; j < used; j++) {
            for (npy_intp b = 0; b < c; b++)
                last[j * c + b] /= scale[b];
            const double most = largest_of(0.0, last + j * c, c);
            if (most <= tail[k])
                continue; /* and so is its power */
            const double power = points / (double)(points - used + j);
            tail[k] = larger(tail[k], most < 1.0 ? pow(most, power) : most != most ? most : 1.0);
        }
    }
    return DONE;
}

/* values (K, points, c) -> the largest size of each component (K, c). */
EVERY_WIDTH static Outcome largest(Call *call)
{
    const npy_intp K = SIZE(K), t = SIZE(t), c = SIZE(c);
    memset(call->out[0], 0, K * c * sizeof(double));
    for (npy_intp k = 0; k < K; k++)
        enlarge(call->out[0] + k * c, call->in[0] + k * t * c, t, c);
    return DONE;
}

/* element (N,), weights, values (K, points, c) -> their weighted sums (N, c). */
EVERY_WIDTH static Outcome sample(Call *call)
{
    const npy_intp t = SIZE(t), c = SIZE(c), *element = call->index[0];
    for (npy_intp i = 0; i < SIZE(N); i++) {
        if (element[i] < 0 || element[i] >= SIZE(K))
            return refused("the element of a time", element[i]);
        combine(call->out[0] + i * c, NULL, call->in[1] + i * t, t,
                call->in[2] + element[i] * t * c, c, c);
    }
    return DONE;
}

/* Edges of elements, places of their points, barycentric weights, times, times that decide about
   the element, how near a point's value is taken -> elements (N,) and weights (N, points). */
static Outcome interpolation(Call *call)
{
    const npy_intp K = SIZE(K), t = SIZE(t);
    const double *edges = call->in[0];
    if (K < 1)
        return refused("elements", K);
    for (npy_intp i = 0; i < SIZE(N); i++) {
        npy_intp low = 0, high = K - 1;
        while (low < high) {
            const npy_intp middle = (low + high) / 2, left = edges[middle + 1] > call->in[4][i];
            high = left ? middle : high;
            low = left ? low : middle + 1;
        }
        const double place = (call->in[3][i] - edges[low]) / (edges[low + 1] - edges[low]);
        double *weights = call->out[1] + i * t, sum = 0.0;
        npy_intp hit = -1;
        call->index_out[0][i] = low;
        for (npy_intp j = 0; j < t; j++) {
            const double distance = place - call->in[1][j];
            if (fabs(distance) < call->number[5])
                hit = j;
            else
                sum += weights[j] = call->in[2][j] / distance;
        }
        for (npy_intp j = 0; j < t; j++)
            weights[j] = hit < 0 ? weights[j] / sum : j == hit;
    }
    return DONE;
}

const Kernel signal_kernels[] = {
    {"tails", "Ktc tt %u # # # |c", "K", tails},
    {"largest", "Ktc", "Kc", largest},
    {"sample", "@N Nt Ktc", "Nc", sample},
    {"interpolation", "K+ t t N N #", "@N Nt", interpolation},
    {NULL, NULL, NULL, NULL},
};
