/* gpebo_cli/numerics/mesh.py: signals on a mesh, whether it resolves them, sampling, filters. */
#include "elements.h"

#include <float.h>

/* --- how well a mesh resolves signals ----------------------------------------------------- */

/* worst (K, used) of one kind, values (K, points, c); `work` holds (K + 1 + used) c numbers. */
EVERY_WIDTH static void tails_of_kind(double *worst, const double *to_legendre, npy_intp used,
                                      npy_intp K, npy_intp points, const double *values, npy_intp c,
                                      double floor, double foot, double share, double *work)
{
    double *scale = work + K * c, *last = scale + c;
    for (npy_intp k = 0; k < K; k++) { /* largest value of each component so far */
        for (npy_intp b = 0; b < c; b++)
            work[k * c + b] = k ? work[(k - 1) * c + b] : 0.0;
        enlarge(work + k * c, values + k * points * c, points, c);
    }
    const double *final = work + (K - 1) * c;
    for (npy_intp k = 0; k < K; k++) {
        for (npy_intp b = 0; b < c; b++)
            scale[b] = larger(work[k * c + b], foot * final[b]);
        const double level = larger(share * largest_of(0.0, scale, c), floor);
        for (npy_intp b = 0; b < c; b++)
            scale[b] = larger(scale[b], level);
        last_coefficients(last, to_legendre, values + k * points * c, used, points, c);
        for (npy_intp j = 0; j < used; j++) {
            for (npy_intp b = 0; b < c; b++)
                last[j * c + b] /= scale[b];
            worst[k * used + j] = largest_of(worst[k * used + j], last + j * c, c);
        }
    }
}

/* tails(to_legendre (s + 1, s + 1), used, foot, share, values (K, s + 1, c), floor, …)

   The tail (K,) of signals of several kinds, see :func:`unresolved_kinds`. */
static PyObject *tails(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, count < 6 ? 6 : count - count % 2))
        return NULL;
    PyArrayObject *L = doubles(&call, 0, 2);
    const npy_intp used = L ? PyLong_AsSsize_t(given[1]) : 0;
    const double foot = L ? PyFloat_AsDouble(given[2]) : 0.0;
    const double share = L ? PyFloat_AsDouble(given[3]) : 0.0;
    if (PyErr_Occurred() || !same("rows and columns of to_legendre", size(L, 0), size(L, 1)))
        return failed(&call);
    const npy_intp points = size(L, 0), s = points - 1;
    if (used < 0 || used > s) {
        PyErr_SetString(PyExc_ValueError, "more Legendre coefficients used than there are");
        return failed(&call);
    }
    npy_intp K = -1, most = 0;
    PyArrayObject *kinds[MOST_HELD];
    double floors[MOST_HELD];
    int found = 0;
    for (Py_ssize_t place = 4; place < count; place += 2, found++) {
        PyArrayObject *kind = doubles(&call, place, 3);
        if (kind == NULL)
            return failed(&call);
        floors[found] = larger(PyFloat_AsDouble(given[place + 1]), DBL_MIN);
        K = K < 0 ? size(kind, 0) : K;
        if (PyErr_Occurred() || !same("elements", size(kind, 0), K) ||
            !same("points", size(kind, 1), points))
            return failed(&call);
        kinds[found] = kind;
        most = size(kind, 2) > most ? size(kind, 2) : most;
    }
    PyArrayObject *tail = fresh(&call, 1, &K);
    double *work = tail ? old_scratch(&call, (size_t)((K + 1 + used) * most + K * used)) : NULL;
    if (work == NULL)
        return failed(&call);
    double *worst = work + (K + 1 + used) * most;
    for (npy_intp i = 0; i < K * used; i++)
        worst[i] = 0.0;
    const double *rows = data(L) + (points - used) * points;
    for (int kind = 0; kind < found; kind++)
        if (K > 0 && size(kinds[kind], 2) > 0)
            tails_of_kind(worst, rows, used, K, points, data(kinds[kind]), size(kinds[kind], 2),
                          floors[kind], foot, share, work);
    for (npy_intp k = 0; k < K; k++) {
        double most_of_all = 0.0;
        for (npy_intp j = 0; j < used; j++) {
            const double ratio = worst[k * used + j];
            const double power = (double)(s + 1) / (double)(s + 1 - used + j);
            most_of_all = larger(most_of_all, ratio > 1.0 ? 1.0 : pow(ratio, power));
        }
        data(tail)[k] = most_of_all;
    }
    return results(&call, 1, tail);
}

/* --- points and sampling ------------------------------------------------------------------ */

/* mesh_points(edges (K + 1,), places (s + 1,), inside)

   The points (K, s + 1) of all elements; and the same with both ends `inside` times the length
   within the element. */
static PyObject *mesh_points(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 3))
        return NULL;
    PyArrayObject *edges = doubles(&call, 0, 1), *places = edges ? doubles(&call, 1, 1) : NULL;
    const double off = places ? PyFloat_AsDouble(given[2]) : 0.0;
    if (PyErr_Occurred())
        return failed(&call);
    const npy_intp K = size(edges, 0) - 1, width = size(places, 0);
    if (K < 0 || width < 2) {
        PyErr_SetString(PyExc_ValueError, "no edge, or fewer than two places");
        return failed(&call);
    }
    PyArrayObject *points = fresh(&call, 2, (npy_intp[]){K, width});
    PyArrayObject *within = points ? fresh(&call, 2, (npy_intp[]){K, width}) : NULL;
    if (within == NULL)
        return failed(&call);
    double *p = data(points), *w = data(within);
    for (npy_intp k = 0; k < K; k++, p += width, w += width) {
        const double left = data(edges)[k], right = data(edges)[k + 1], step = right - left;
        for (npy_intp i = 0; i < width; i++)
            p[i] = left + step * data(places)[i];
        p[width - 1] = right;
        memcpy(w, p, width * sizeof(double));
        w[0] += off * step;
        w[width - 1] -= off * step;
    }
    return results(&call, 2, points, within);
}

/* split(edges (K + 1,), parts (K,))

   Edges of the mesh whose element k is cut into parts[k] equal ones, and for each new element the
   old one it equals, or −1. */
static PyObject *split(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 2))
        return NULL;
    PyArrayObject *edges = doubles(&call, 0, 1), *parts = edges ? indices(&call, 1, 1) : NULL;
    if (parts == NULL || !same("edges and parts", size(edges, 0), size(parts, 0) + 1))
        return failed(&call);
    const npy_intp K = size(parts, 0), *into = (const npy_intp *)PyArray_DATA(parts);
    npy_intp total = 0;
    for (npy_intp k = 0; k < K; k++) {
        if (into[k] < 0 || into[k] > NPY_MAX_INTP / 16 - total) {
            PyErr_Format(PyExc_ValueError, "%zd parts", (Py_ssize_t)into[k]);
            return failed(&call);
        }
        total += into[k];
    }
    PyArrayObject *finer = fresh(&call, 1, (npy_intp[]){total + 1});
    PyObject *equals = finer ? PyArray_SimpleNew(1, (npy_intp[]){total}, NPY_INTP) : NULL;
    if (equals == NULL)
        return failed(&call);
    npy_intp *kept = (npy_intp *)PyArray_DATA((PyArrayObject *)equals);
    double *out = data(finer);
    for (npy_intp k = 0; k < K; k++) {
        const double left = data(edges)[k], step = data(edges)[k + 1] - left;
        for (npy_intp i = 0; i < into[k]; i++) {
            *out++ = left + step * ((double)i / (double)into[k]);
            *kept++ = into[k] == 1 ? k : -1;
        }
    }
    *out = data(edges)[K];
    PyObject *answer = Py_BuildValue("(ON)", (PyObject *)finer, equals);
    failed(&call); /* gives back what was held */
    return answer;
}

/* sampler(edges (K + 1,), places (s + 1,), barycentric (s + 1,), t (N,), inside (N,) or None,
   snap, exact)

   The elements (N,) that contain `inside`, or t moved to the right by `snap` |t|, and the weights
   (N, s + 1) of interpolation at t; nearer than `exact` a point's own value is taken. */
static PyObject *sampler(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 7))
        return NULL;
    PyArrayObject *edges = doubles(&call, 0, 1), *places = edges ? doubles(&call, 1, 1) : NULL;
    PyArrayObject *barycentric = places ? doubles(&call, 2, 1) : NULL;
    PyArrayObject *t = barycentric ? doubles(&call, 3, 1) : NULL, *inside = NULL;
    if (t == NULL || (given[4] != Py_None && (inside = doubles(&call, 4, 1)) == NULL))
        return failed(&call);
    const double snap = PyFloat_AsDouble(given[5]), exact = PyFloat_AsDouble(given[6]);
    const npy_intp K = size(edges, 0) - 1, width = size(places, 0), N = size(t, 0);
    if (PyErr_Occurred() || !same("places and weights", width, size(barycentric, 0)) ||
        (inside != NULL && !same("times and where they are decided", N, size(inside, 0))))
        return failed(&call);
    if (K < 1) {
        PyErr_SetString(PyExc_ValueError, "no element");
        return failed(&call);
    }
    PyArrayObject *weights = fresh(&call, 2, (npy_intp[]){N, width});
    PyObject *chosen = weights ? PyArray_SimpleNew(1, (npy_intp[]){N}, NPY_INTP) : NULL;
    if (chosen == NULL)
        return failed(&call);
    npy_intp *element = (npy_intp *)PyArray_DATA((PyArrayObject *)chosen), e = 0;
    const double *edge = data(edges);
    for (npy_intp i = 0; i < N; i++) {
        const double when = data(t)[i];
        const double belongs = inside ? data(inside)[i] : when + snap * fabs(when);
        if (!(edge[e] <= belongs && (e == K - 1 || belongs < edge[e + 1]))) {
            npy_intp above = K; /* the first edge beyond, but one of 1 … K; NaN: the last */
            for (e = 0; above - e > 1;) {
                const npy_intp middle = e + (above - e) / 2;
                if (edge[middle] > belongs)
                    above = middle;
                else
                    e = middle;
            }
        }
        element[i] = e;
        const double local = (when - edge[e]) / (edge[e + 1] - edge[e]);
        double *restrict row = data(weights) + i * width, sum = 0.0;
        int hits = 0;
        for (npy_intp j = 0; j < width; j++) {
            const double distance = local - data(places)[j];
            if (fabs(distance) < exact)
                hits++;
            row[j] = data(barycentric)[j] / distance;
        }
        for (npy_intp j = 0; hits && j < width; j++)
            row[j] = fabs(local - data(places)[j]) < exact ? 1.0 : 0.0;
        for (npy_intp j = 0; j < width; j++)
            sum += row[j];
        for (npy_intp j = 0; j < width; j++)
            row[j] /= sum;
    }
    PyObject *answer = Py_BuildValue("(NO)", chosen, (PyObject *)weights);
    failed(&call); /* gives back what was held */
    return answer;
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

/* sample(element (N,), weights (N, s + 1), values (K, s + 1, c)): their weighted sums (N, c). */
static PyObject *sample(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 3))
        return NULL;
    PyArrayObject *element = indices(&call, 0, 1), *weights = element ? doubles(&call, 1, 2) : NULL;
    PyArrayObject *values = weights ? doubles(&call, 2, 3) : NULL;
    if (values == NULL || !same("elements and weights", size(element, 0), size(weights, 0)) ||
        !same("weights and points", size(weights, 1), size(values, 1)))
        return failed(&call);
    const npy_intp N = size(element, 0), K = size(values, 0), c = size(values, 2);
    const npy_intp *which = (const npy_intp *)PyArray_DATA(element);
    for (npy_intp i = 0; i < N; i++)
        if (which[i] < 0 || which[i] >= K) {
            PyErr_Format(PyExc_ValueError, "element %zd of %zd", (Py_ssize_t)which[i],
                         (Py_ssize_t)K);
            return failed(&call);
        }
    PyArrayObject *out = fresh(&call, 2, (npy_intp[]){N, c});
    if (out == NULL)
        return failed(&call);
    weighted_sums(data(out), which, data(weights), data(values), N, size(weights, 1), c);
    return results(&call, 1, out);
}

/* --- integrals and filters ---------------------------------------------------------------- */

/* Integrals (K, s + 1, c) of :func:`integral`; `total` (c,) is zero, and NULL for each element's
   own. */
EVERY_WIDTH static void integrate(double *out, const double *R, const double *steps,
                                  const double *values, npy_intp K, npy_intp s, npy_intp c,
                                  double *total)
{
    for (npy_intp k = 0; k < K; k++, values += (s + 1) * c, out += (s + 1) * c) {
        for (npy_intp b = 0; b < c; b++)
            out[b] = total ? total[b] : 0.0;
        for (npy_intp i = 0; i < s; i++) {
            double *row = out + (i + 1) * c;
            combine(row, NULL, R + i * s, s, values + c, c, c);
            for (npy_intp b = 0; b < c; b++)
                row[b] = steps[k] * row[b] + out[b];
        }
        for (npy_intp b = 0; total && b < c; b++)
            total[b] = out[s * c + b];
    }
}

/* integral(R (s, s), steps (K,), values (K, s + 1, c), on)

   Integrals (K, s + 1, c) from the left end of each element, or, if `on`, of the first one. */
static PyObject *integral(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 4))
        return NULL;
    PyArrayObject *R = doubles(&call, 0, 2), *steps = R ? doubles(&call, 1, 1) : NULL;
    PyArrayObject *values = steps ? doubles(&call, 2, 3) : NULL;
    const int on = values ? PyObject_IsTrue(given[3]) : -1;
    if (on < 0)
        return failed(&call);
    const npy_intp K = size(values, 0), s = size(values, 1) - 1, c = size(values, 2);
    if (!same("steps and elements", size(steps, 0), K) || !same("rows of R", size(R, 0), s) ||
        !same("columns of R", size(R, 1), s))
        return failed(&call);
    PyArrayObject *integrals = fresh(&call, 3, PyArray_DIMS(values));
    double *total = integrals ? old_scratch(&call, c) : NULL;
    if (total == NULL)
        return failed(&call);
    for (npy_intp b = 0; b < c; b++)
        total[b] = 0.0;
    integrate(data(integrals), data(R), data(steps), data(values), K, s, c, on ? total : NULL);
    return results(&call, 1, integrals);
}

/* low_pass(D (s, s), steps (K,), values (K, s + 1, c), rates (c,), start (c,))

   Z (K, s + 1, c) of Z' = −λ (Z − S) with a rate for each column; None if a system is singular.
   Columns that share a rate share a factorisation. */
static PyObject *low_pass(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 5))
        return NULL;
    PyArrayObject *D = doubles(&call, 0, 2), *steps = D ? doubles(&call, 1, 1) : NULL;
    PyArrayObject *values = steps ? doubles(&call, 2, 3) : NULL;
    PyArrayObject *rates = values ? doubles(&call, 3, 1) : NULL;
    PyArrayObject *start = rates ? doubles(&call, 4, 1) : NULL;
    if (start == NULL)
        return failed(&call);
    const npy_intp K = size(values, 0), s = size(values, 1) - 1, c = size(values, 2);
    if (!same("steps and elements", size(steps, 0), K) || !same("rows of D", size(D, 0), s) ||
        !same("columns of D", size(D, 1), s) || !same("rates", size(rates, 0), c) ||
        !same("columns of the start", size(start, 0), c))
        return failed(&call);
    PyArrayObject *filtered = fresh(&call, 3, PyArray_DIMS(values));
    double *W = filtered ? old_scratch(&call, s * row_length(s, 1 + c)) : NULL;
    double *state = W ? old_scratch(&call, c + s) : NULL;
    int *columns = state ? integers(&call, 2 * c) : NULL;
    if (columns == NULL)
        return failed(&call);
    double *from_left = state + c;
    for (npy_intp i = 0; i < s; i++) {
        from_left[i] = 0.0;
        for (npy_intp j = 0; j < s; j++)
            from_left[i] += data(D)[i * s + j];
    }
    int *done = columns + c;
    memset(done, 0, c * sizeof(int));
    for (npy_intp first = 0; first < c; first++) {
        if (done[first])
            continue;
        const double rate = data(rates)[first];
        npy_intp found = 0;
        for (npy_intp b = first; b < c; b++)
            if (b == first || data(rates)[b] == rate) {
                done[b] = 1;
                columns[found++] = (int)b;
            }
        for (npy_intp b = 0; b < found; b++)
            state[b] = data(start)[columns[b]];
        const npy_intp length = row_length(s, 1 + found);
        for (npy_intp k = 0; k < K; k++) {
            const double hl = rate * data(steps)[k];
            const double *v = data(values) + k * (s + 1) * c;
            double *out = data(filtered) + k * (s + 1) * c;
            for (npy_intp i = 0; i < s; i++) {
                double *row = W + i * length;
                memcpy(row, data(D) + i * s, s * sizeof(double));
                row[i] += hl;
                row[s] = from_left[i];
                for (npy_intp b = 0; b < found; b++)
                    row[s + 1 + b] = hl * v[(i + 1) * c + columns[b]];
                for (npy_intp b = s + 1 + found; b < length; b++)
                    row[b] = 0.0;
            }
            if (!eliminate(W, s, 1 + found)) {
                failed(&call);
                Py_RETURN_NONE;
            }
            for (npy_intp b = 0; b < found; b++)
                out[columns[b]] = state[b];
            for (npy_intp i = 0; i < s; i++) {
                const double *row = W + i * length + s;
                for (npy_intp b = 0; b < found; b++)
                    out[(i + 1) * c + columns[b]] = row[0] * state[b] + row[1 + b];
            }
            for (npy_intp b = 0; b < found; b++)
                state[b] = out[s * c + columns[b]];
        }
    }
    return results(&call, 1, filtered);
}

PyMethodDef mesh_kernels[] = {
    KERNEL(tails),  KERNEL(mesh_points), KERNEL(split),    KERNEL(sampler),
    KERNEL(sample), KERNEL(integral),    KERNEL(low_pass), {NULL, NULL, 0, NULL},
};
