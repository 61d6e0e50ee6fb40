/* How well a mesh resolves signals, sampling; see signals_numpy.py. */
#include "elements.h"

/* The largest of the last coefficients of each element, to the power that makes of degree j one of
   the degree `points`. Components that are smaller than `least` (c,), if there is one, count as
   that large, and all are compared in these units. `work` holds (K + 2 + used) c numbers. */
EVERY_WIDTH static void tails_of_kind(double *tail, const double *to_legendre, npy_intp used,
                                      npy_intp K, npy_intp points, const double *values, npy_intp c,
                                      const double *least, double floor, double foot, double share,
                                      double *work)
{
    double *scale = work + K * c, *unit = scale + c, *last = unit + c;
    for (npy_intp k = 0; k < K; k++) { /* largest value of each component so far */
        for (npy_intp b = 0; b < c; b++)
            work[k * c + b] = k ? work[(k - 1) * c + b] : 0.0;
        enlarge(work + k * c, values + k * points * c, points, c);
    }
    const double *final = work + (K - 1) * c;
    for (npy_intp b = 0; b < c; b++)
        unit[b] = least ? larger(larger(final[b], least[b]), DBL_MIN) : 1.0;
    for (npy_intp k = 0; k < K; k++) {
        for (npy_intp b = 0; b < c; b++) {
            const int small = least && final[b] < unit[b];
            scale[b] = small ? 1.0 : larger(work[k * c + b], foot * final[b]) / unit[b];
        }
        const double level = larger(share * largest_of(0.0, scale, c), floor);
        for (npy_intp b = 0; b < c; b++)
            scale[b] = larger(scale[b], level) * unit[b];
        last_coefficients(last, to_legendre, values + k * points * c, used, points, c);
        tail[k] = 0.0;
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
}

/* Values of one kind, to_legendre, `used`, foot, share, floor, least sizes or None -> the tail of
   each element relative to the components' sizes so far. */
static Outcome tails(Call *call)
{
    const npy_intp K = SIZE(K), t = SIZE(t), c = SIZE(c), used = SIZE(u);
    if (used >= t)
        return refused("Legendre coefficients", used);
    double *work = scratch(call, (K + 2 + used) * c);
    if (work == NULL)
        return ERROR;
    memset(call->out[0], 0, K * sizeof(double));
    if (K > 0 && c > 0)
        tails_of_kind(call->out[0], call->in[1] + (t - used) * t, used, K, t, call->in[0], c,
                      call->in[6], larger(call->number[5], DBL_MIN), call->number[3],
                      call->number[4], work);
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

/* out (N, c): each the weighted sum of the point values (points, c) of its element. */
EVERY_WIDTH static void weighted_sums(double *out, const npy_intp *element, const double *weights,
                                      const double *values, npy_intp N, npy_intp points, npy_intp c)
{
    for (npy_intp i = 0; i < N; i++, weights += points, out += c) {
        const double *v = values + element[i] * points * c;
        combine(out, NULL, weights, points, v, c, c);
    }
}

/* element (N,), weights, values -> their weighted sums (N, c). */
static Outcome sample(Call *call)
{
    const npy_intp N = SIZE(N), K = SIZE(K);
    for (npy_intp i = 0; i < N; i++)
        if (call->index[0][i] < 0 || call->index[0][i] >= K)
            return refused("the element of a time", call->index[0][i]);
    weighted_sums(call->out[0], call->index[0], call->in[1], call->in[2], N, SIZE(t), SIZE(c));
    return DONE;
}

/* The weights (points,) at a place in an element; nearer than `exact` to a point, its value is taken. */
static void weigh(double *weights, double place, const double *places, const double *barycentric,
                  npy_intp points, double exact)
{
    npy_intp hit = -1;
    double sum = 0.0;
    for (npy_intp j = 0; j < points; j++) {
        const double distance = place - places[j];
        if (fabs(distance) < exact)
            hit = j;
        else
            sum += weights[j] = barycentric[j] / distance;
    }
    for (npy_intp j = 0; j < points; j++)
        weights[j] = hit < 0 ? weights[j] / sum : j == hit;
}

/* Edges of elements, places of their points, barycentric weights, times, times that decide about
   the element, what is near enough -> elements (N,) and weights (N, points). */
static Outcome interpolation(Call *call)
{
    const npy_intp K = SIZE(K), t = SIZE(t);
    const double *edges = call->in[0];
    if (K < 1)
        return refused("elements", K);
    for (npy_intp i = 0; i < SIZE(N); i++) {
        npy_intp low = 0, high = K - 1;
        while (low < high) {
            const npy_intp middle = (low + high) / 2;
            if (edges[middle + 1] > call->in[4][i])
                high = middle;
            else
                low = middle + 1;
        }
        const double place = (call->in[3][i] - edges[low]) / (edges[low + 1] - edges[low]);
        call->index_out[0][i] = low;
        weigh(call->out[1] + i * t, place, call->in[1], call->in[2], t, call->number[5]);
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
