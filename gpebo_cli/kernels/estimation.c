/* gpebo_cli/estimators, metrics.py and experiment.py: mixing, the scalar law of DREM, and what is
   measured of estimates. */
#include "common.h"

#include <float.h>

/* Cases side by side: recurrences that do not wait for one another, in as many registers. */
#define LANES 8
/* For what is compiled twice: for LANES cases, and for one, without padding. */
#if defined(__GNUC__)
#define TWICE static inline __attribute__((always_inline))
#else
#define TWICE static inline
#endif
#define FEW 3       /* cases: up to here one after the other is faster than LANES with padding */
#define TOGETHER 32 /* times at once when errors are measured */

/* How far apart the values of two times are: 0 for an array (1, …) that is constant in time. */
static npy_intp stride(npy_intp times, npy_intp numbers) { return times == 1 ? 0 : numbers; }

/* Whether an array of `given` times goes with `wanted` ones; an exception that names it if not. */
static int timed(const char *what, npy_intp given, npy_intp wanted)
{
    return given == 1 || same(what, given, wanted);
}

/* one · other, with a power of two taken out where it would become too small or too large. */
static inline double times_power(double one, double other, int *exponent)
{
    const double size = fabs(other), product = one * other;
    if ((size > 1e-100 && size < 1e100 && fabs(product) > 1e-100 && fabs(product) < 1e100) ||
        !isfinite(one) || !isfinite(other))
        return product;
    int first, second;
    const double mantissa = frexp(one, &first) * frexp(other, &second);
    *exponent += first + second;
    return mantissa;
}

/* Solves A X = B as solve_in_place does, and gives det A, without under- or overflow on the way;
   0 for a pivot of zero, and then there is no X. */
static double solve_and_determinant(double *A, double *B, npy_intp n, npy_intp columns)
{
    const int sign = solve_in_place(A, B, n, columns);
    double mantissa = sign;
    int exponent = 0;
    for (npy_intp k = 0; sign && k < n; k++)
        mantissa = times_power(mantissa, A[k * n + k], &exponent);
    return exponent ? ldexp(mantissa, exponent) : mantissa;
}

/* Frobenius norm of the first n columns of A (rows, columns). */
static double frobenius(const double *A, npy_intp rows, npy_intp columns, npy_intp n)
{
    double sum = 0.0;
    for (npy_intp i = 0; i < rows; i++)
        for (npy_intp j = 0; j < n; j++)
            sum += A[i * columns + j] * A[i * columns + j];
    return sqrt(sum);
}

/* Rows (points, numbers) that are no good become the next good one, the last good one at the end,
   zero if there is none. */
static void fill(double *rows, const int *good, npy_intp points, npy_intp numbers)
{
    npy_intp last = points - 1;
    while (last >= 0 && !good[last])
        last--;
    if (last < 0) {
        memset(rows, 0, points * numbers * sizeof(double));
        return;
    }
    for (npy_intp i = last + 1; i < points; i++)
        memcpy(rows + i * numbers, rows + last * numbers, numbers * sizeof(double));
    for (npy_intp i = last - 1; i >= 0; i--)
        if (!good[i])
            memcpy(rows + i * numbers, rows + (i + 1) * numbers, numbers * sizeof(double));
}

/* [Ω | 𝒴] (K, s + 1, p, p + c), reciprocal condition below which Ω is singular
   -> Δ = det Ω (K, s + 1), η̄ = Ω⁻¹𝒴 (K, s + 1, p c), filled where Ω is singular. */
static PyObject *mixed_points(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    double singular;
    if (!begin(&call, given, count, 2))
        return NULL;
    PyArrayObject *extended = doubles(&call, 0, 4);
    if (extended == NULL || !number(&call, 1, &singular))
        return failed(&call);
    const npy_intp elements = size(extended, 0), each = size(extended, 1), p = size(extended, 2);
    const npy_intp c = size(extended, 3) - p, width = p + c, points = elements * each;
    if (c < 0) {
        same("rows and columns of the extension", p, width);
        return failed(&call);
    }
    PyArrayObject *delta = fresh(&call, 2, (npy_intp[]){elements, each});
    PyArrayObject *quotient = delta ? fresh(&call, 3, (npy_intp[]){elements, each, p * c}) : NULL;
    double *omega = quotient ? scratch(&call, p * p + p * width) : NULL;
    int *good = omega ? integers(&call, points) : NULL;
    if (good == NULL)
        return failed(&call);
    double *both = omega + p * p;
    for (npy_intp k = 0; k < points; k++) {
        const double *values = data(extended) + k * p * width;
        double *out = data(quotient) + k * p * c;
        /* Ω⁻¹ beside Ω⁻¹𝒴: ‖Ω‖ ‖Ω⁻¹‖ is at most p times the condition number. */
        for (npy_intp i = 0; i < p; i++) {
            memcpy(omega + i * p, values + i * width, p * sizeof(double));
            for (npy_intp j = 0; j < p; j++)
                both[i * width + j] = i == j;
            memcpy(both + i * width + p, values + i * width + p, c * sizeof(double));
        }
        const double determinant = solve_and_determinant(omega, both, p, width);
        data(delta)[k] = determinant;
        good[k] = 0;
        if (determinant != 0.0) {
            const double condition = frobenius(values, p, width, p) * frobenius(both, p, width, p);
            good[k] = condition * singular < 1.0; /* not if it is NaN */
        }
        if (good[k])
            for (npy_intp i = 0; i < p; i++)
                memcpy(out + i * c, both + i * width + p, c * sizeof(double));
    }
    fill(data(quotient), good, points, p * c);
    return results(&call, 2, delta, quotient);
}

/* Ω (N, p, p) -> det Ω (N,). */
static PyObject *determinants(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 1))
        return NULL;
    PyArrayObject *omega = doubles(&call, 0, 3);
    if (omega == NULL || !same("rows and columns", size(omega, 1), size(omega, 2)))
        return failed(&call);
    const npy_intp points = size(omega, 0), p = size(omega, 1);
    PyArrayObject *delta = fresh(&call, 1, &points);
    double *own = delta ? scratch(&call, p * p) : NULL;
    if (own == NULL)
        return failed(&call);
    for (npy_intp k = 0; k < points; k++) {
        memcpy(own, data(omega) + k * p * p, p * p * sizeof(double));
        data(delta)[k] = solve_and_determinant(own, own, p, 0);
    }
    return results(&call, 1, delta);
}

/* Δ (K, s + 1), lengths of the elements (K,), integration of the rule (s, s)
   -> I = ∫Δ² (K, s + 1), which never falls. */
static PyObject *energy(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 3))
        return NULL;
    PyArrayObject *delta = doubles(&call, 0, 2), *steps = delta ? doubles(&call, 1, 1) : NULL;
    PyArrayObject *rule = steps ? doubles(&call, 2, 2) : NULL;
    if (rule == NULL || !same("elements", size(delta, 0), size(steps, 0)) ||
        !same("stages", size(delta, 1), size(rule, 0) + 1) ||
        !same("rows and columns of the rule", size(rule, 0), size(rule, 1)))
        return failed(&call);
    const npy_intp elements = size(delta, 0), s = size(rule, 0);
    PyArrayObject *out = fresh(&call, 2, (npy_intp[]){elements, s + 1});
    if (out == NULL)
        return failed(&call);
    double left = 0.0, largest = 0.0;
    for (npy_intp k = 0; k < elements; k++) {
        const double *d = data(delta) + k * (s + 1) + 1;
        double *E = data(out) + k * (s + 1), local = 0.0;
        E[0] = largest = larger(largest, left);
        for (npy_intp i = 0; i < s; i++) {
            local = 0.0;
            for (npy_intp j = 0; j < s; j++)
                local += data(rule)[i * s + j] * (d[j] * d[j]);
            local *= data(steps)[k];
            E[i + 1] = largest = larger(largest, local + left);
        }
        left += local;
    }
    return results(&call, 1, out);
}

/* The length of a step of I from a point to the next, not below zero. */
static inline double step_length(const double *E) { return E[1] - E[0] < 0.0 ? 0.0 : E[1] - E[0]; }

/* I (K, s + 1), η̄ (K, s + 1, p), the largest γ -> (2,): the largest change of η̄ from a point to
   the next times min(1, γδI), and the largest |η̄| of the last element. */
static PyObject *law_variation(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    double gain;
    if (!begin(&call, given, count, 3))
        return NULL;
    PyArrayObject *energies = doubles(&call, 0, 2);
    PyArrayObject *quotient = energies ? doubles(&call, 1, 3) : NULL;
    if (quotient == NULL || !number(&call, 2, &gain) ||
        !same("elements", size(energies, 0), size(quotient, 0)) ||
        !same("points", size(energies, 1), size(quotient, 1)))
        return failed(&call);
    const npy_intp elements = size(energies, 0), each = size(energies, 1), p = size(quotient, 2);
    PyArrayObject *out = zeros(&call, 1, (npy_intp[]){2});
    if (out == NULL)
        return failed(&call);
    double variation = 0.0, largest = 0.0;
    for (npy_intp k = 0; k < elements; k++)
        for (npy_intp i = 0; i + 1 < each; i++) {
            const double x = gain * step_length(data(energies) + k * each + i);
            const double weight = x > 1.0 ? 1.0 : x;
            const double *one = data(quotient) + (k * each + i) * p;
            for (npy_intp j = 0; j < p; j++)
                variation = larger(variation, weight * fabs(one[p + j] - one[j]));
        }
    for (npy_intp i = elements ? (elements - 1) * each * p : 0; i < elements * each * p; i++)
        largest = larger(largest, fabs(data(quotient)[i]));
    data(out)[0] = variation;
    data(out)[1] = largest;
    return results(&call, 1, out);
}

/* From LEAST down x is as good as 0. */
#define LEAST 1e-300
/* From GONE up e^{−x} is zero, which the library finds out slowly. */
#define GONE 746.0

/* e^{−x} of some values x = γδ ≥ 0, and its mean (1 − e^{−x})/x over a step, 1 at x = 0. */
TWICE void decays_of_one(const double *restrict gamma, double length, double *restrict end,
                         double *restrict mean, const int lanes)
{
    for (int b = 0; b < lanes; b++) {
        const double x = gamma[b] * length;
        if (x > 0.5) { /* 1 − e^{−x} has all its digits */
            end[b] = x < GONE ? exp(-x) : 0.0;
            mean[b] = (1.0 - end[b]) / x;
        } else if (x <= LEAST) {
            end[b] = mean[b] = 1.0;
        } else {
            const double q = expm1(-x);
            end[b] = 1.0 + q;
            mean[b] = -q / x;
        }
    }
}

/* The same for cases with a gain for each of `own` parameters: all (own, lanes). */
TWICE void decays(const double *gamma, double length, npy_intp own, double *end, double *mean,
                  const int lanes)
{
    for (npy_intp i = 0; i < own * lanes; i += lanes)
        decays_of_one(gamma + i, length, end + i, mean + i, lanes);
}

/* Where the times are between the points of a path: the point before each (M,), I from there on
   (M,) and its share in the step (M,). */
typedef struct {
    npy_intp *point;
    double *partial, *share;
} Places;

/* A path that the law takes: I (K, s + 1) and η̄ (K, s + 1, p). */
typedef struct {
    const double *energy, *quotient;
    npy_intp elements, each, p;
} Path;

/* Some cases at once. */
typedef struct {
    npy_intp own;               /* gains of each: 1, or one for each of the p parameters */
    double *gamma, *end, *mean; /* (own, lanes) gains, and room for their decays */
    double *distance;           /* (N or 1, p, lanes) η̂ − η̄ at the left end of every step */
} Cases;

/* Takes over the gains (own,) and the distances from η̄ (p,) of the starts (p,) of `some` cases;
   what is left of the lanes repeats the last one. */
TWICE void begin_cases(const Cases *cases, const double *quotient, npy_intp p, const double *start,
                       npy_intp start_stride, const double *gains, npy_intp some, const int lanes)
{
    for (npy_intp b = 0; b < lanes; b++) {
        const npy_intp one = b < some ? b : some - 1;
        for (npy_intp i = 0; i < cases->own; i++)
            cases->gamma[i * lanes + b] = gains[one * cases->own + i];
        for (npy_intp j = 0; j < p; j++)
            cases->distance[j * lanes + b] = start[one * start_stride + j] - quotient[j];
    }
}

/* The law of `some` ≤ lanes cases with η̄ constant: η̂ (some, times, p), see constant_law. */
TWICE void constant_cases(const double *at, npy_intp times, const double *final, npy_intp p,
                          const double *start, npy_intp start_stride, const double *gains,
                          npy_intp some, const Cases *cases, double *eta, const int lanes)
{
    begin_cases(cases, final, p, start, start_stride, gains, some, lanes);
    for (npy_intp m = 0; m < times; m++) {
        decays(cases->gamma, at[m], cases->own, cases->end, cases->mean, lanes);
        for (npy_intp b = 0; b < some; b++)
            for (npy_intp j = 0; j < p; j++) {
                const npy_intp lane = cases->own == 1 ? b : j * lanes + b;
                eta[(b * times + m) * p + j] =
                    final[j] + cases->end[lane] * cases->distance[j * lanes + b];
            }
    }
}

/* For many and for few cases, see TWICE. */
EVERY_WIDTH static void constant_lanes(const double *at, npy_intp times, const double *final,
                                       npy_intp p, const double *start, npy_intp start_stride,
                                       const double *gains, npy_intp some, const Cases *cases,
                                       double *eta)
{
    if (some < FEW)
        constant_cases(at, times, final, p, start, start_stride, gains, 1, cases, eta, 1);
    else
        constant_cases(at, times, final, p, start, start_stride, gains, some, cases, eta, LANES);
}

/* I at the times (M,), η̄ (p,), η̂ at the start (1 or g, p), γ (g, 1 or p)
   -> η̂ = η̄ + e^{−γI} (η̂(0) − η̄) (g, M, p). */
static PyObject *constant_law(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 4))
        return NULL;
    PyArrayObject *at = doubles(&call, 0, 1), *final = at ? doubles(&call, 1, 1) : NULL;
    PyArrayObject *start = final ? doubles(&call, 2, 2) : NULL;
    PyArrayObject *gains = start ? doubles(&call, 3, 2) : NULL;
    if (gains == NULL)
        return failed(&call);
    const npy_intp times = size(at, 0), p = size(final, 0), g = size(gains, 0);
    const npy_intp own = size(gains, 1);
    if (!same("parameters at the start", size(start, 1), p) ||
        !timed("cases at the start", size(start, 0), g) ||
        !(own == 1 || same("parameters with a gain", own, p)))
        return failed(&call);
    PyArrayObject *out = fresh(&call, 3, (npy_intp[]){g, times, p});
    double *room = out ? scratch(&call, (p + 3 * own) * LANES) : NULL;
    if (room == NULL)
        return failed(&call);
    const Cases cases = {own, room, room + own * LANES, room + 2 * own * LANES,
                         room + 3 * own * LANES};
    const npy_intp start_stride = stride(size(start, 0), p);
    for (npy_intp first = 0; first < g;) {
        const double *from = data(start) + first * start_stride, *gamma = data(gains) + first * own;
        double *eta = data(out) + first * times * p;
        const npy_intp some = g - first < LANES ? g - first : LANES;
        constant_lanes(data(at), times, data(final), p, from, start_stride, gamma, some, &cases,
                       eta);
        first += some < FEW ? 1 : some;
    }
    return results(&call, 1, out);
}

/* The law with η̄ linear in I between the points: the distances at the left end of every step
   from those at the start. */
TWICE void go_along(const Path *path, const Cases *cases, const int lanes)
{
    const npy_intp each = path->each, p = path->p, own = cases->own;
    double *distance = cases->distance, *const end = cases->end, *const mean = cases->mean;
    for (npy_intp k = 0; k < path->elements; k++)
        for (npy_intp i = 0; i + 1 < each; i++, distance += p * lanes) {
            const double *left = path->quotient + (k * each + i) * p;
            const int jumps = i + 2 == each; /* η̂ does not, where η̄ does */
            if (jumps && k + 1 == path->elements)
                return;
            decays(cases->gamma, step_length(path->energy + k * each + i), own, end, mean, lanes);
            for (npy_intp j = 0; j < p; j++) {
                const double change = left[p + j] - left[j];
                const double jump = jumps ? left[2 * p + j] - left[p + j] : 0.0;
                const npy_intp lane = own == 1 ? 0 : j * lanes;
                double *restrict d = distance + j * lanes, *restrict next = d + p * lanes;
                for (int b = 0; b < lanes; b++)
                    next[b] = end[lane + b] * d[b] + (-mean[lane + b] * change - jump);
            }
        }
}

/* Where in the steps of I (K, s + 1) the times are, from the element of each (M,), its place in
   it and I there (M,); 0 with an exception for an element that there is not. */
static int find_places(const Path *path, const double *edges, const double *points, const double *t,
                       const npy_intp *element, const double *at, npy_intp times, Places *places)
{
    const npy_intp elements = path->elements, each = path->each;
    for (npy_intp m = 0; m < times; m++) {
        const npy_intp k = element[m];
        if (k < 0 || k >= elements) {
            PyErr_Format(PyExc_ValueError, "element %zd of %zd", (Py_ssize_t)k,
                         (Py_ssize_t)elements);
            return 0;
        }
        const double local = (t[m] - edges[k]) / (edges[k + 1] - edges[k]);
        npy_intp i = 0;
        while (i + 2 < each && !(points[i + 1] > local))
            i++;
        const double step = step_length(path->energy + k * each + i);
        double partial = at[m] - path->energy[k * each + i];
        partial = partial < 0.0 ? 0.0 : partial > step ? step : partial;
        if (partial == step && i + 2 < each) { /* the next point itself: nothing to go there */
            i++;
            partial = 0.0;
        }
        places->point[m] = k * each + i;
        places->partial[m] = partial;
        places->share[m] = partial > 0.0 ? partial / step : 0.0;
    }
    return 1;
}

/* The law of `some` ≤ lanes cases, starts (p,) of each and γ (own,) of each at `stride` numbers
   from one another: η̂ (some, times, p). */
TWICE void linear_cases(const Path *path, const Places *places, npy_intp times, const double *start,
                        npy_intp start_stride, const double *gains, npy_intp some,
                        const Cases *cases, double *eta, const int lanes)
{
    const npy_intp p = path->p, own = cases->own;
    begin_cases(cases, path->quotient, p, start, start_stride, gains, some, lanes);
    go_along(path, cases, lanes);
    for (npy_intp m = 0; m < times; m++) {
        const npy_intp point = places->point[m];
        const double *left = path->quotient + point * p;
        const double share = places->share[m];
        const double *d = cases->distance + (point - point / path->each) * p * lanes;
        if (places->partial[m] == 0.0) {
            for (npy_intp b = 0; b < some; b++)
                for (npy_intp j = 0; j < p; j++)
                    eta[(b * times + m) * p + j] = left[j] + d[j * lanes + b];
            continue;
        }
        decays(cases->gamma, places->partial[m], own, cases->end, cases->mean, lanes);
        for (npy_intp j = 0; j < p; j++) {
            const double change = share * (left[p + j] - left[j]);
            const npy_intp lane = own == 1 ? 0 : j * lanes;
            for (npy_intp b = 0; b < some; b++)
                eta[(b * times + m) * p + j] = left[j] + cases->end[lane + b] * d[j * lanes + b] +
                                               (1.0 - cases->mean[lane + b]) * change;
        }
    }
}

/* For many and for few cases. */
EVERY_WIDTH static void linear_lanes(const Path *path, const Places *places, npy_intp times,
                                     const double *start, npy_intp start_stride,
                                     const double *gains, npy_intp some, const Cases *cases,
                                     double *eta)
{
    if (some < FEW)
        linear_cases(path, places, times, start, start_stride, gains, 1, cases, eta, 1);
    else
        linear_cases(path, places, times, start, start_stride, gains, some, cases, eta, LANES);
}

/* I (K, s + 1), η̄ (K, s + 1, p), edges (K + 1,), points of the rule (s + 1,), times (M,), their
   elements (M,), I there (M,), η̂ at the start (1 or g, p), γ (g, 1 or p)
   -> η̂ (g, M, p) of the law with η̄ linear in I between neighbouring points. */
static PyObject *linear_law(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 9))
        return NULL;
    PyArrayObject *energies = doubles(&call, 0, 2);
    PyArrayObject *quotient = energies ? doubles(&call, 1, 3) : NULL;
    PyArrayObject *edges = quotient ? doubles(&call, 2, 1) : NULL;
    PyArrayObject *points = edges ? doubles(&call, 3, 1) : NULL;
    PyArrayObject *t = points ? doubles(&call, 4, 1) : NULL;
    PyArrayObject *element = t ? indices(&call, 5, 1) : NULL;
    PyArrayObject *at = element ? doubles(&call, 6, 1) : NULL;
    PyArrayObject *start = at ? doubles(&call, 7, 2) : NULL;
    PyArrayObject *gains = start ? doubles(&call, 8, 2) : NULL;
    if (gains == NULL)
        return failed(&call);
    const npy_intp elements = size(energies, 0), each = size(energies, 1);
    const npy_intp p = size(quotient, 2), times = size(t, 0), g = size(gains, 0);
    const npy_intp own = size(gains, 1);
    if (!same("elements", size(quotient, 0), elements) ||
        !same("points", size(quotient, 1), each) || !same("edges", size(edges, 0), elements + 1) ||
        !same("points of the rule", size(points, 0), each) ||
        !same("elements of the times", size(element, 0), times) ||
        !same("energies at the times", size(at, 0), times) ||
        !same("parameters at the start", size(start, 1), p) ||
        !timed("cases at the start", size(start, 0), g) ||
        !(own == 1 || same("parameters with a gain", own, p)))
        return failed(&call);
    if (elements < 1 || each < 2) {
        PyErr_SetString(PyExc_ValueError, "a path needs a step");
        return failed(&call);
    }
    const npy_intp steps = elements * (each - 1);
    PyArrayObject *out = fresh(&call, 3, (npy_intp[]){g, times, p});
    double *work = out ? scratch(&call, 2 * times + (steps * p + 3 * own) * LANES) : NULL;
    PyArrayObject *where = work ? fresh(&call, 1, &times) : NULL; /* as wide as an index */
    if (where == NULL)
        return failed(&call);
    Places places = {(npy_intp *)PyArray_DATA(where), work, work + times};
    double *room = work + 2 * times;
    const Path path = {data(energies), data(quotient), elements, each, p};
    const Cases cases = {own, room, room + own * LANES, room + 2 * own * LANES,
                         room + 3 * own * LANES};
    if (!find_places(&path, data(edges), data(points), data(t),
                     (const npy_intp *)PyArray_DATA(element), data(at), times, &places))
        return failed(&call);
    const npy_intp start_stride = stride(size(start, 0), p);
    for (npy_intp first = 0; first < g;) {
        const double *from = data(start) + first * start_stride, *gamma = data(gains) + first * own;
        double *eta = data(out) + first * times * p;
        const npy_intp some = g - first < LANES ? g - first : LANES;
        linear_lanes(&path, &places, times, from, start_stride, gamma, some, &cases, eta);
        first += some < FEW ? 1 : some;
    }
    return results(&call, 1, out);
}

/* What is known of the error norms of some cases as time goes on; squares, because roots cost
   more. */
typedef struct {
    double level[LANES];  /* the square that counts as settled */
    double above[LANES];  /* the last square above it */
    double below[LANES];  /* the one after */
    npy_intp last[LANES]; /* index of the last one above, −1 if there is none */
    double before[LANES]; /* the last square of all */
    double sum[LANES];    /* twice the integral of the squares, by trapezoids */
} Course;

/* Takes the squares (count, lanes) at the times from index `first` on. */
TWICE void follow(Course *course, const double *squares, const double *t, npy_intp first,
                  npy_intp count, double fraction, const int lanes)
{
    if (first == 0)
        for (int b = 0; b < lanes; b++) {
            course->level[b] = fraction * fraction * squares[b];
            course->last[b] = -1;
            course->before[b] = squares[b];
            course->sum[b] = 0.0;
        }
    for (npy_intp m = 0; m < count; m++) {
        const double step = first + m > 0 ? t[first + m] - t[first + m - 1] : 0.0;
        const double *square = squares + m * lanes;
        for (int b = 0; b < lanes; b++)
            course->sum[b] += step * (square[b] + course->before[b]);
        for (int b = 0; b < lanes; b++)
            course->before[b] = square[b];
    }
    for (int b = 0; b < lanes; b++) {
        if (first > 0 && course->last[b] == first - 1)
            course->below[b] = squares[b];
        npy_intp m = count - 1;
        while (m >= 0 && !(squares[m * lanes + b] > course->level[b]))
            m--;
        if (m < 0)
            continue;
        course->last[b] = first + m;
        course->above[b] = squares[m * lanes + b];
        if (m + 1 < count)
            course->below[b] = squares[(m + 1) * lanes + b];
    }
}

/* Logarithm of an error from its square, not below that of the smallest number. */
static double logarithm(double square)
{
    const double error = sqrt(square);
    return log(error < DBL_MIN ? DBL_MIN : error);
}

/* When the error has settled, counted from the first time; see metrics.settling_time. */
static double settled(const Course *course, npy_intp b, const double *t, npy_intp times)
{
    const npy_intp last = course->last[b];
    if (last < 0)
        return 0.0;
    if (last == times - 1)
        return NAN;
    const double high = logarithm(course->above[b]), low = logarithm(course->below[b]);
    const double fall = high - low < DBL_MIN ? DBL_MIN : high - low;
    double share = (high - logarithm(course->level[b])) / fall;
    share = share < 0.0 ? 0.0 : share > 1.0 ? 1.0 : share;
    return t[last] + share * (t[last + 1] - t[last]) - t[0];
}

/* x̂_i = offset_i + Σ_j gain_ij η̂_j of some cases, η̂ (p, lanes). */
TWICE void state(double offset, const double *gain, const double *eta, npy_intp p, double *x,
                 const int lanes)
{
    double sum[LANES] = {0.0};
    for (npy_intp j = 0; j < p; j++)
        for (int b = 0; b < lanes; b++)
            sum[b] += gain[j] * eta[j * lanes + b];
    for (int b = 0; b < lanes; b++)
        x[b] = offset + sum[b];
}

/* Adds the squares of the errors of some values, and notes their sizes if asked to. */
TWICE void add_error(const double *value, double truth, double *restrict square,
                     double *restrict worst, const int lanes)
{
    for (int b = 0; b < lanes; b++)
        square[b] += (value[b] - truth) * (value[b] - truth);
    if (worst != NULL)
        for (int b = 0; b < lanes; b++)
            worst[b] = larger(worst[b], fabs(value[b] - truth));
}

/* An array of numbers for every time, or one for all of them. */
typedef struct {
    const double *values;
    npy_intp stride;
} Signal;

static inline const double *at_time(Signal signal, npy_intp m)
{
    return signal.values + m * signal.stride;
}

/* What estimates are measured against. */
typedef struct {
    const double *t;                     /* (M,) */
    Signal truth, offset, gain, x;       /* η (p,), offset (n,) and gain (n, p) of x̂, x (n,) */
    npy_intp times, p, n, columns, kept; /* M, p, n, and how many of the next */
    const npy_intp *column, *keep;       /* parameters that are judged, times that are kept */
    const int *known, *known_x;          /* which of the columns (columns,) and states (n,) are */
    int of_eta, of_x;                    /* whether there is anything to measure */
    double fraction;                     /* at which an error has settled */
} Measure;

/* Where the results for some cases go: numbers (5, stride), η̂ (some, k, p) and x̂ (some, k, n). */
typedef struct {
    double *numbers, *eta, *x;
    npy_intp stride;
} Found;

/* Measures `some` ≤ lanes cases of η̂ (some, M, p); room for (TOGETHER, p, lanes) numbers. */
TWICE void measure_cases(const Measure *with, const double *estimates, npy_intp some, double *room,
                         Found found, const int lanes)
{
    const npy_intp times = with->times, p = with->p, n = with->n, last = times - 1;
    Course of[2];
    double worst[2][LANES] = {{0.0}}, x[LANES];
    for (npy_intp from = 0; from < times; from += TOGETHER) {
        const npy_intp now = times - from < TOGETHER ? times - from : TOGETHER;
        double squares[2][TOGETHER * LANES];
        for (int i = 0; i < 2; i++)
            memset(squares[i], 0, now * lanes * sizeof(double));
        for (npy_intp b = 0; b < lanes; b++) {
            const double *own = estimates + ((b < some ? b : some - 1) * times + from) * p;
            for (npy_intp i = 0; i < now * p; i++)
                room[i * lanes + b] = own[i];
        }
        for (npy_intp i = 0; i < now; i++) {
            const npy_intp m = from + i;
            const double *eta = room + i * p * lanes, *gain = at_time(with->gain, m);
            const double *truth = at_time(with->truth, m), *true_x = at_time(with->x, m);
            const double *offset = at_time(with->offset, m);
            for (npy_intp j = 0; j < with->columns; j++)
                if (with->known[j])
                    add_error(eta + with->column[j] * lanes, truth[with->column[j]],
                              squares[0] + i * lanes, m == last ? worst[0] : NULL, lanes);
            for (npy_intp j = 0; j < n; j++)
                if (with->known_x[j]) {
                    state(offset[j], gain + j * p, eta, p, x, lanes);
                    add_error(x, true_x[j], squares[1] + i * lanes, m == last ? worst[1] : NULL,
                              lanes);
                }
        }
        for (int i = 0; i < 2; i++)
            follow(of + i, squares[i], with->t, from, now, with->fraction, lanes);
    }
    for (npy_intp b = 0; b < some; b++) {
        double *one = found.numbers + b;
        one[0] = with->of_eta ? settled(of, b, with->t, times) : NAN;
        one[found.stride] = with->of_x ? settled(of + 1, b, with->t, times) : NAN;
        one[2 * found.stride] = with->of_eta ? worst[0][b] : NAN;
        one[3 * found.stride] = with->of_x ? worst[1][b] : NAN;
        one[4 * found.stride] =
            with->of_x ? sqrt(0.5 * of[1].sum[b] / (with->t[last] - with->t[0])) : NAN;
    }
    for (npy_intp k = 0; k < with->kept; k++) {
        const npy_intp m = with->keep[k];
        for (npy_intp b = 0; b < lanes; b++)
            for (npy_intp j = 0; j < p; j++)
                room[j * lanes + b] = estimates[((b < some ? b : some - 1) * times + m) * p + j];
        for (npy_intp b = 0; b < some; b++)
            for (npy_intp j = 0; j < p; j++)
                found.eta[(b * with->kept + k) * p + j] = room[j * lanes + b];
        for (npy_intp i = 0; i < n; i++) {
            state(at_time(with->offset, m)[i], at_time(with->gain, m) + i * p, room, p, x, lanes);
            for (npy_intp b = 0; b < some; b++)
                found.x[(b * with->kept + k) * n + i] = x[b];
        }
    }
}

/* For many and for few cases. */
EVERY_WIDTH static void measure_lanes(const Measure *with, const double *estimates, npy_intp some,
                                      double *room, Found found)
{
    if (some < FEW)
        measure_cases(with, estimates, 1, room, found, 1);
    else
        measure_cases(with, estimates, some, room, found, LANES);
}

/* Notes what is known, from the end of the first case (M, p): NaN is what nobody knows. */
static void find_known(Measure *with, const double *estimates, int *known)
{
    const npy_intp p = with->p, last = with->times - 1;
    const double *eta = estimates + last * p, *gain = at_time(with->gain, last);
    with->of_eta = with->columns == 0;
    with->of_x = 0;
    with->known = known;
    with->known_x = known + with->columns;
    for (npy_intp i = 0; i < with->columns; i++, known++) {
        const npy_intp j = with->column[i];
        *known = !isnan(eta[j] - at_time(with->truth, last)[j]);
        with->of_eta |= *known;
    }
    for (npy_intp i = 0; i < with->n; i++, known++) {
        double x;
        state(at_time(with->offset, last)[i], gain + i * p, eta, p, &x, 1);
        *known = !isnan(x - at_time(with->x, last)[i]);
        with->of_x |= *known;
    }
}

/* Times (M,), η̂ (g, M, p), η (1 or M, p), columns of η that are judged (c,), offset (1 or M, n)
   and gain (1 or M, n, p) of x̂ = offset + gain η̂, x (1 or M, n), indices of the times that are
   kept (k,), fraction at which an error has settled
   -> numbers (5, g), η̂ and x̂ at the times that are kept, (g, k, p) and (g, k, n).

   The numbers are those of experiment._measure, its definition: NaN at the end of the first case
   is what nobody knows and does not count. */
static PyObject *measured(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    double fraction;
    if (!begin(&call, given, count, 9))
        return NULL;
    PyArrayObject *t = doubles(&call, 0, 1), *estimates = t ? doubles(&call, 1, 3) : NULL;
    PyArrayObject *truth = estimates ? doubles(&call, 2, 2) : NULL;
    PyArrayObject *judged = truth ? indices(&call, 3, 1) : NULL;
    PyArrayObject *offset = judged ? doubles(&call, 4, 2) : NULL;
    PyArrayObject *gain = offset ? doubles(&call, 5, 3) : NULL;
    PyArrayObject *true_x = gain ? doubles(&call, 6, 2) : NULL;
    PyArrayObject *chosen = true_x ? indices(&call, 7, 1) : NULL;
    if (chosen == NULL || !number(&call, 8, &fraction))
        return failed(&call);
    const npy_intp g = size(estimates, 0), times = size(t, 0), p = size(estimates, 2);
    const npy_intp n = size(offset, 1), kept = size(chosen, 0), columns = size(judged, 0);
    if (!same("times of the estimates", size(estimates, 1), times) ||
        !timed("times of the truth", size(truth, 0), times) ||
        !timed("times of the offset", size(offset, 0), times) ||
        !timed("times of the gain", size(gain, 0), times) ||
        !timed("times of the states", size(true_x, 0), times) ||
        !same("parameters of the truth", size(truth, 1), p) ||
        !same("parameters of the gain", size(gain, 2), p) ||
        !same("states of the gain", size(gain, 1), n) || !same("states", size(true_x, 1), n))
        return failed(&call);
    const npy_intp *column = (const npy_intp *)PyArray_DATA(judged);
    const npy_intp *keep = (const npy_intp *)PyArray_DATA(chosen);
    npy_intp outside = times < 1;
    for (npy_intp i = 0; i < columns; i++)
        outside |= column[i] < 0 || column[i] >= p;
    for (npy_intp i = 0; i < kept; i++)
        outside |= keep[i] < 0 || keep[i] >= times;
    if (outside) {
        PyErr_SetString(PyExc_ValueError, "an index of a parameter or a time that there is not");
        return failed(&call);
    }
    PyArrayObject *out = fresh(&call, 2, (npy_intp[]){5, g});
    PyArrayObject *kept_eta = out ? fresh(&call, 3, (npy_intp[]){g, kept, p}) : NULL;
    PyArrayObject *kept_x = kept_eta ? fresh(&call, 3, (npy_intp[]){g, kept, n}) : NULL;
    double *room = kept_x ? scratch(&call, TOGETHER * p * LANES) : NULL;
    int *known = room ? integers(&call, columns + n) : NULL;
    if (known == NULL)
        return failed(&call);
    Measure with = {
        .t = data(t),
        .times = times,
        .p = p,
        .n = n,
        .columns = columns,
        .column = column,
        .kept = kept,
        .keep = keep,
        .fraction = fraction,
        .truth = {data(truth), stride(size(truth, 0), p)},
        .offset = {data(offset), stride(size(offset, 0), n)},
        .gain = {data(gain), stride(size(gain, 0), n * p)},
        .x = {data(true_x), stride(size(true_x, 0), n)},
    };
    if (g)
        find_known(&with, data(estimates), known);
    for (npy_intp first = 0; first < g;) {
        const double *eta = data(estimates) + first * times * p;
        const Found found = {data(out) + first, data(kept_eta) + first * kept * p,
                             data(kept_x) + first * kept * n, g};
        const npy_intp some = g - first < LANES ? g - first : LANES;
        measure_lanes(&with, eta, some, room, found);
        first += some < FEW ? 1 : some;
    }
    return results(&call, 3, out, kept_eta, kept_x);
}

PyMethodDef estimation_kernels[] = {
    KERNEL(mixed_points), KERNEL(determinants), KERNEL(energy),   KERNEL(law_variation),
    KERNEL(constant_law), KERNEL(linear_law),   KERNEL(measured), {NULL, NULL, 0, NULL},
};
