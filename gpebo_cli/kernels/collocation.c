/* gpebo_cli/numerics/collocation.py: element systems, chaining, error estimates. */
#include "elements.h"

#include <float.h>

/* --- the element systems ------------------------------------------------------------------ */

/* Values at points, the same at all of them where `step` is 0; NULL for what is not there. */
typedef struct {
    const double *from;
    npy_intp step;
} Moving;

static inline const double *at(Moving values, npy_intp point)
{
    return values.from + point * values.step;
}

/* The equation of some elements, d equations for n components, and memory to work in. */
typedef struct {
    npy_intp s, d, n, columns;
    const double *D; /* (s, s) */
    Moving E, A, f, T, p;
    double *h;        /* lengths (K,) */
    double *Dh;       /* (s, s): D/h of an element */
    double *together; /* (n, s d): T at all nodes of an element, side by side */
    double *coupling; /* (s d,): a row of E times that */
    double *slope;    /* (s, n, columns): D p/h */
    double *AT;       /* (d, d) */
    double *taken;    /* (columns,) */
} Equation;

/* Node i of element k among all points. */
static inline npy_intp node(const Equation *q, npy_intp k, npy_intp i)
{
    return k * (q->s + 1) + 1 + i;
}

/* (D_ij/h E_i T_j − δ_ij A_i T_i) of element k into the first s d columns of W, and the response
   to the left end, (D𝟙)_i/h E_i, into the next n. */
EVERY_WIDTH static void assemble(const Equation *q, npy_intp k, double *W, npy_intp length)
{
    const npy_intp s = q->s, d = q->d, n = q->n, m = s * d;
    const int varying = q->T.from != NULL && q->T.step != 0;
    const npy_intp apart = varying ? d : 0; /* what couples to the next node */
    for (npy_intp j = 0; varying && j < s; j++) {
        const double *T = at(q->T, node(q, k, j));
        for (npy_intp c = 0; c < n; c++)
            for (npy_intp b = 0; b < d; b++)
                q->together[c * m + j * d + b] = T[c * d + b];
    }
    for (npy_intp i = 0; i < s; i++) {
        const npy_intp point = node(q, k, i);
        const double *A = at(q->A, point), *Dh = q->Dh + i * s;
        if (q->T.from != NULL) {
            for (npy_intp a = 0; a < d; a++)
                combine(q->AT + a * d, NULL, A + a * n, n, at(q->T, point), d, d);
            A = q->AT;
        }
        double start = 0.0;
        for (npy_intp j = 0; j < s; j++)
            start += Dh[j];
        for (npy_intp a = 0; a < d; a++) {
            double *row = W + (i * d + a) * length, *response = row + m;
            if (q->E.from == NULL) {
                memset(row, 0, (m + n) * sizeof(double));
                for (npy_intp j = 0; j < s; j++)
                    row[j * d + a] = Dh[j];
                response[a] = start;
            } else {
                const double *E = at(q->E, point) + a * n, *coupled = q->coupling;
                if (varying)
                    combine(q->coupling, NULL, E, n, q->together, m, m);
                else if (q->T.from != NULL)
                    combine(q->coupling, NULL, E, n, q->T.from, d, d);
                else
                    coupled = E;
                for (npy_intp j = 0; j < s; j++)
                    for (npy_intp b = 0; b < d; b++)
                        row[j * d + b] = Dh[j] * coupled[j * apart + b];
                for (npy_intp c = 0; c < n; c++)
                    response[c] = start * E[c];
            }
            for (npy_intp b = 0; b < d; b++)
                row[i * d + b] -= A[a * d + b];
        }
    }
}

/* What drives z at the nodes of element k, f + A p − E (D p)/h, into columns of W from `place`. */
EVERY_WIDTH static void drive(const Equation *q, npy_intp k, double *W, npy_intp length,
                              npy_intp place)
{
    const npy_intp s = q->s, d = q->d, n = q->n, columns = q->columns, size = n * columns;
    if (q->p.from != NULL)
        for (npy_intp i = 0; i < s; i++)
            combine(q->slope + i * size, NULL, q->Dh + i * s, s, at(q->p, node(q, k, 0)), q->p.step,
                    size);
    for (npy_intp i = 0; i < s; i++) {
        const npy_intp point = node(q, k, i);
        const double *f = at(q->f, point), *slope = q->slope + i * size;
        for (npy_intp a = 0; a < d; a++, f += columns) {
            double *right = W + (i * d + a) * length + place;
            if (q->p.from == NULL) {
                memcpy(right, f, columns * sizeof(double));
                continue;
            }
            combine(right, f, at(q->A, point) + a * n, n, at(q->p, point), columns, columns);
            if (q->E.from != NULL) {
                combine(q->taken, NULL, at(q->E, point) + a * n, n, slope, columns, columns);
                slope = q->taken;
            }
            for (npy_intp c = 0; c < columns; c++)
                right[c] -= slope[c];
            slope = q->slope + i * size;
        }
    }
}

/* D/h of element k. */
static inline void lengthen(const Equation *q, npy_intp k)
{
    for (npy_intp i = 0; i < q->s * q->s; i++)
        q->Dh[i] = q->D[i] / q->h[k];
}

/* out (s, n, width) = T_i z_i (+ p_i where it is `added`), z_i (d, width) in W from `place` on. */
EVERY_WIDTH static void expand(const Equation *q, npy_intp k, const double *W, npy_intp length,
                               npy_intp place, npy_intp width, int added, double *out)
{
    const npy_intp s = q->s, d = q->d, n = q->n;
    for (npy_intp i = 0; i < s; i++) {
        const npy_intp point = node(q, k, i);
        const double *z = W + i * d * length + place;
        const double *p = added && q->p.from != NULL ? at(q->p, point) : NULL;
        for (npy_intp c = 0; c < n; c++, out += width) {
            const double *offset = p == NULL ? NULL : p + c * width;
            if (q->T.from == NULL)
                memcpy(out, z + c * length, width * sizeof(double));
            else
                combine(out, offset, at(q->T, point) + c * d, d, z, length, width);
        }
    }
}

/* Elements 0 … count − 1, one system each; 0 if one is singular. */
static int distinct_elements(const Equation *q, npy_intp count, double *W, double *homogeneous,
                             double *particular)
{
    const npy_intp m = q->s * q->d, n = q->n, sides = n + q->columns;
    const npy_intp length = row_length(m, sides);
    for (npy_intp k = 0; k < count; k++) {
        for (npy_intp i = 0; i < m; i++)
            for (npy_intp j = m + sides; j < length; j++)
                W[i * length + j] = 0.0;
        lengthen(q, k);
        assemble(q, k, W, length);
        drive(q, k, W, length, m + n);
        if (!eliminate(W, m, sides))
            return 0;
        expand(q, k, W, length, m, n, 0, homogeneous + k * q->s * n * n);
        expand(q, k, W, length, m + n, q->columns, 1, particular + k * q->s * n * q->columns);
    }
    return 1;
}

/* Elements of one length under constant E, A and T: one system for all, whose responses to the
   left end are the same; 0 if it is singular. */
static int equal_elements(const Equation *q, const int *members, npy_intp count, double *W,
                          double *homogeneous, double *particular)
{
    const npy_intp m = q->s * q->d, n = q->n, columns = q->columns, sides = n + count * columns;
    const npy_intp length = row_length(m, sides);
    for (npy_intp i = 0; i < m; i++)
        for (npy_intp j = m + sides; j < length; j++)
            W[i * length + j] = 0.0;
    lengthen(q, members[0]);
    assemble(q, members[0], W, length);
    for (npy_intp k = 0; k < count; k++) {
        lengthen(q, members[k]);
        drive(q, members[k], W, length, m + n + k * columns);
    }
    if (!eliminate(W, m, sides))
        return 0;
    expand(q, members[0], W, length, m, n, 0, homogeneous);
    for (npy_intp k = 0; k < count; k++)
        expand(q, members[k], W, length, m + n + k * columns, columns, 1,
               particular + members[k] * q->s * n * columns);
    return 1;
}

/* An argument with values at points, or None; 0, with an exception, if it is neither, or has not
   `rows` rows and `columns` columns at each of `points` points or at one for all. */
static int moving(Call *call, Py_ssize_t place, const char *what, npy_intp points, npy_intp rows,
                  npy_intp columns, Moving *out)
{
    *out = (Moving){NULL, 0};
    if (call->given[place] == Py_None)
        return 1;
    PyArrayObject *array = doubles(call, place, 3);
    if (array == NULL || !same(what, size(array, 1), rows) || !same(what, size(array, 2), columns))
        return 0;
    const int constant = size(array, 0) == 1;
    if (!constant && !same(what, size(array, 0), points))
        return 0;
    *out = (Moving){data(array), constant ? 0 : rows * columns};
    return 1;
}

/* element_maps(D (s, s), h (K,), E or None, A, f, T or None, p or None, equal)

   E, A (N or 1, d, n) and f (N or 1, d, columns) at the N = K (s + 1) points of K elements; with
   constraints T (N or 1, n, d) and p (N or 1, n, columns), else d = n. Where E, A and T are
   constant, lengths that differ by `equal` times the longest, or less, count as equal.

   Returns the responses to the left end (K or 1, s, n, n), one for all elements if they are the
   same, and the particular solutions (K, s, n, columns); None if a system is singular. */
static PyObject *element_maps(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 8))
        return NULL;
    PyArrayObject *D = doubles(&call, 0, 2), *h = D ? doubles(&call, 1, 1) : NULL;
    PyArrayObject *A = h ? doubles(&call, 3, 3) : NULL, *f = A ? doubles(&call, 4, 3) : NULL;
    const double equal = PyFloat_AsDouble(given[7]);
    if (f == NULL || PyErr_Occurred() || !same("rows and columns of D", size(D, 0), size(D, 1)))
        return failed(&call);
    Equation q = {.s = size(D, 0), .d = size(A, 1), .n = size(A, 2), .columns = size(f, 2)};
    const npy_intp K = size(h, 0), s = q.s, d = q.d, n = q.n, columns = q.columns, m = s * d;
    const npy_intp points = K * (s + 1);
    if (!moving(&call, 2, "points, rows or columns of E", points, d, n, &q.E) ||
        !moving(&call, 3, "points, rows or columns of A", points, d, n, &q.A) ||
        !moving(&call, 4, "points, rows or columns of f", points, d, columns, &q.f) ||
        !moving(&call, 5, "points, rows or columns of T", points, n, d, &q.T) ||
        !moving(&call, 6, "points, rows or columns of p", points, n, columns, &q.p))
        return failed(&call);
    if ((q.T.from == NULL && !same("rows and columns of A", d, n)) ||
        !same("constraints with an offset", q.T.from != NULL, q.p.from != NULL) ||
        (q.T.from != NULL && !same("constraints with E", 1, q.E.from != NULL)))
        return failed(&call);
    q.D = data(D);
    q.h = data(h);
    double longest = 0.0;
    for (npy_intp k = 0; k < K; k++)
        longest = q.h[k] > longest ? q.h[k] : longest;
    const int constant = q.A.step == 0 && q.E.step == 0 && q.T.step == 0;
    const npy_intp sides = n + columns * (constant ? K : 1);
    q.together = old_scratch(&call, (n + 1) * m + s * n * columns + d * d + s * s + columns);
    double *W = q.together ? old_scratch(&call, m * row_length(m, sides)) : NULL;
    int *members = W ? integers(&call, 2 * K) : NULL;
    PyArrayObject *particular = members ? fresh(&call, 4, (npy_intp[]){K, s, n, columns}) : NULL;
    if (particular == NULL)
        return failed(&call);
    q.coupling = q.together + n * m;
    q.slope = q.coupling + m;
    q.AT = q.slope + s * n * columns;
    q.Dh = q.AT + d * d;
    q.taken = q.Dh + s * s;
    /* The group of one length that each element belongs to, the first element of each group. */
    int groups = 0, *group = members + K;
    for (npy_intp k = 0; constant && k < K; k++) {
        group[k] = 0;
        while (group[k] < groups && !(fabs(q.h[k] - q.h[members[group[k]]]) <= equal * longest))
            group[k]++;
        if (group[k] == groups)
            members[groups++] = (int)k;
    }
    const npy_intp own = constant && groups == 1 ? 1 : K, block = s * n * n;
    PyArrayObject *homogeneous = fresh(&call, 4, (npy_intp[]){own, s, n, n});
    if (homogeneous == NULL)
        return failed(&call);
    int solved = 1;
    if (!constant)
        solved = distinct_elements(&q, K, W, data(homogeneous), data(particular));
    for (int g = 0; solved && constant && g < groups; g++) {
        npy_intp found = 0;
        for (npy_intp k = 0; k < K; k++)
            if (group[k] == g)
                members[found++] = (int)k;
        double *first = data(homogeneous) + (own == 1 ? 0 : members[0]) * block;
        solved = equal_elements(&q, members, found, W, first, data(particular));
        for (npy_intp i = 1; own != 1 && i < found; i++)
            memcpy(data(homogeneous) + members[i] * block, first, block * sizeof(double));
    }
    if (!solved) {
        return no_answer(&call);
    }
    return results(&call, 2, homogeneous, particular);
}

/* --- chaining ----------------------------------------------------------------------------- */

/* out (rows, columns) = a (rows, n) x (n, columns) + b (rows, columns). */
static inline void affine(double *out, const double *a, const double *x, const double *b,
                          npy_intp rows, npy_intp n, npy_intp columns)
{
    for (npy_intp i = 0; i < rows; i++)
        combine(out + i * columns, b + i * columns, a + i * n, n, x, columns, columns);
}

/* Whether all numbers are finite. */
static inline int all_finite(const double *values, npy_intp count)
{
    int bad = 0;
    for (npy_intp i = 0; i < count; i++)
        bad |= !(fabs(values[i]) <= DBL_MAX);
    return !bad;
}

/* Values (K, s + 1, n, columns) by :func:`chain`; returns how many elements in front are finite. */
EVERY_WIDTH static npy_intp link_up(double *out, const double *H, npy_intp apart, const double *P,
                                    const double *state, npy_intp K, npy_intp s, npy_intp n,
                                    npy_intp columns)
{
    const npy_intp block = n * columns;
    npy_intp whole = 0;
    for (npy_intp k = 0; k < K; k++, out += (s + 1) * block) {
        memcpy(out, state, block * sizeof(double));
        affine(out + block, H + k * apart, out, P + k * s * block, s * n, n, columns);
        whole += whole == k && all_finite(out, (s + 1) * block);
        state = out + s * block;
    }
    return whole;
}

/* chain(homogeneous (K or 1, s, n, n), particular (K, s, n, columns), start (n, columns))

   Returns the values (K, s + 1, n, columns), and how many elements in front are finite. */
static PyObject *chain(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 3))
        return NULL;
    PyArrayObject *H = doubles(&call, 0, 4), *P = H ? doubles(&call, 1, 4) : NULL;
    PyArrayObject *start = P ? doubles(&call, 2, 2) : NULL;
    if (start == NULL)
        return failed(&call);
    const npy_intp K = size(P, 0), s = size(P, 1), n = size(P, 2), columns = size(P, 3);
    const npy_intp constant = size(H, 0) == 1;
    if ((!constant && !same("elements", size(H, 0), K)) || !same("stages", size(H, 1), s) ||
        !same("components", size(H, 2), n) || !same("components", size(H, 3), n) ||
        !same("components of the start", size(start, 0), n) ||
        !same("columns of the start", size(start, 1), columns))
        return failed(&call);
    PyArrayObject *values = fresh(&call, 4, (npy_intp[]){K, s + 1, n, columns});
    if (values == NULL)
        return failed(&call);
    const npy_intp whole = link_up(data(values), data(H), constant ? 0 : s * n * n, data(P),
                                   data(start), K, s, n, columns);
    PyObject *answer = Py_BuildValue("(On)", (PyObject *)values, (Py_ssize_t)whole);
    failed(&call); /* gives back what was held */
    return answer;
}

/* --- refinement --------------------------------------------------------------------------- */

/* merged(before (K or 1, width), after (F or 1, width), kept (N,)) -> (N, width)

   Row i is row kept[i] of `before`, or the only one it has; where kept[i] < 0, it is the next one
   of `after`, or the only one. */
static PyObject *merged(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 3))
        return NULL;
    PyArrayObject *before = doubles(&call, 0, 2), *after = before ? doubles(&call, 1, 2) : NULL;
    PyArrayObject *kept = after ? indices(&call, 2, 1) : NULL;
    if (kept == NULL || !same("numbers of an element", size(before, 1), size(after, 1)))
        return failed(&call);
    const npy_intp K = size(before, 0), N = size(kept, 0), width = size(before, 1);
    const npy_intp *from = (const npy_intp *)PyArray_DATA(kept);
    npy_intp fresh_ones = 0, largest = -1;
    for (npy_intp i = 0; i < N; i++) {
        fresh_ones += from[i] < 0;
        largest = from[i] > largest ? from[i] : largest;
    }
    const int shared = size(after, 0) == 1;
    if (!shared && !same("new elements", size(after, 0), fresh_ones))
        return failed(&call);
    if (largest >= 0 && (K == 0 || (K > 1 && largest >= K))) {
        PyErr_Format(PyExc_ValueError, "element %zd of %zd", (Py_ssize_t)largest, (Py_ssize_t)K);
        return failed(&call);
    }
    PyArrayObject *out = fresh(&call, 2, (npy_intp[]){N, width});
    if (out == NULL)
        return failed(&call);
    double *to = data(out);
    const double *next = data(after);
    for (npy_intp i = 0; i < N; i++, to += width) {
        const double *one = data(before) + (K > 1 && from[i] >= 0 ? from[i] * width : 0);
        if (from[i] < 0) {
            one = next;
            next += shared ? 0 : width;
        }
        memcpy(to, one, width * sizeof(double));
    }
    return results(&call, 1, out);
}

/* --- error estimates ---------------------------------------------------------------------- */

#define LAST 4 /* Legendre coefficients that are looked at */

/* scale (C,) = size (C,), but not below `share` of the largest, nor below `floor`. */
static void floored(double *scale, const double *size, npy_intp C, double share, double floor)
{
    double largest = 0.0;
    for (npy_intp c = 0; c < C; c++)
        largest = larger(largest, size[c]);
    const double least = larger(larger(share * largest, floor), DBL_MIN);
    for (npy_intp c = 0; c < C; c++)
        scale[c] = larger(size[c], least);
}

/* Local errors (C,) of the right end of an element from its last Legendre coefficients (used, C),
   see :func:`_propagated_error`. */
static void local_errors(double *local, const double *last, const double *size, const double *scale,
                         npy_intp s, npy_intp used, npy_intp C)
{
    const double half = 0.5 * (double)(s - 1) / (double)s;
    for (npy_intp c = 0; c < C; c++) {
        double worst = -INFINITY; /* logarithm of tail/scale */
        for (npy_intp j = 0; j < used; j++) {
            const double ratio = last[j * C + c] / scale[c];
            const double power = (double)(s + 1) / (double)(s + 1 - used + j);
            worst = larger(worst, ratio > 1.0 ? 0.0 : power * log(ratio));
        }
        const double own = larger(size[c], DBL_MIN);
        const double decay = worst + log(scale[c] / own);
        const double rounding = 4 * DBL_EPSILON * larger(size[c], scale[c] * DBL_EPSILON);
        local[c] = scale[c] * exp(worst + half * (decay > 0.0 ? 0.0 : decay)) + rounding;
    }
}

/* What :func:`estimates` is of: the arguments, and memory for (K + 14) n columns numbers. */
typedef struct {
    npy_intp K, s, n, columns, used, apart; /* apart: numbers between the maps of two elements */
    const double *H, *V, *to_legendre, *amplified;
    double floor, share, level;
    double *work;
} Ending;

/* Accumulated error, visible noise and rounding into found (3,). */
EVERY_WIDTH static void judge(const Ending *q, double *found)
{
    const npy_intp K = q->K, s = q->s, n = q->n, columns = q->columns, used = q->used;
    const npy_intp C = n * columns, points = s + 1, rows = points < LAST ? points : LAST;
    double *work = q->work;
    double *sizes = work, *whole = sizes + K * C, *scale = whole + C, *last = scale + C;
    double *noise = last + LAST * C, *local = noise + C, *error = local + C;
    double *before = error + 2 * C, *worst = before + 2 * C, *brought = worst + C;
    for (npy_intp c = 0; c < C; c++)
        whole[c] = noise[c] = worst[c] = brought[c] = 0.0;
    for (npy_intp k = 0; k < K; k++) {
        for (npy_intp c = 0; c < C; c++)
            sizes[k * C + c] = 0.0;
        enlarge(sizes + k * C, q->V + k * points * C, points, C);
        enlarge(whole, sizes + k * C, 1, C);
    }
    floored(scale, whole, C, q->share, 0.0);
    const double *to_legendre = q->to_legendre + (points - rows) * points;
    for (npy_intp k = 0; k < K; k++) {
        last_coefficients(last, to_legendre, q->V + k * points * C, rows, points, C);
        for (npy_intp c = 0; s >= LAST && c < C; c++) {
            const double earlier = larger(last[c], last[C + c]);
            const double after = larger(last[2 * C + c], last[3 * C + c]);
            if (after >= q->level * earlier)
                noise[c] = larger(noise[c], after);
        }
        local_errors(local, last + (rows - used) * C, sizes + k * C, scale, s, used, C);
        /* All signs equal, and alternating. */
        for (int e = 0; e < 2; e++) {
            const double sign = e && k % 2 ? -1.0 : 1.0;
            double *own = error + e * C;
            for (npy_intp c = 0; c < C; c++)
                brought[c] = sign * local[c];
            if (k == 0) {
                memcpy(own, brought, C * sizeof(double));
            } else {
                const double *h = q->H + k * q->apart + (s - 1) * n * n;
                memcpy(before + e * C, own, C * sizeof(double));
                affine(own, h, before + e * C, brought, n, n, columns);
            }
            for (npy_intp c = 0; c < C; c++)
                worst[c] = larger(worst[c], fabs(own[c]));
        }
    }
    double propagated = 0.0, visible = 0.0, rounding = 0.0, largest = 0.0;
    for (npy_intp c = 0; c < C; c++) {
        propagated = larger(propagated, worst[c] / scale[c]);
        visible = larger(visible, noise[c] / scale[c]);
        largest = larger(largest, whole[c]);
        brought[c] = 0.0;
    }
    for (npy_intp i = 0; q->amplified != NULL && i < n; i++)
        for (npy_intp c = 0; c < columns; c++) {
            const double *by = q->amplified + i * (n + 1);
            double sum = 0.0;
            for (npy_intp e = 0; e < n; e++)
                sum += by[e] * whole[e * columns + c];
            brought[i * columns + c] = DBL_EPSILON * (sum + by[n]);
        }
    floored(scale, whole, C, q->share, q->floor);
    for (npy_intp c = 0; c < C; c++)
        rounding = larger(rounding, (DBL_EPSILON * largest + brought[c]) / scale[c]);
    found[0] = propagated;
    found[1] = visible;
    found[2] = rounding;
}

/* estimates(homogeneous (K or 1, s, n, n), values (K, s + 1, n, columns), to_legendre, used,
   amplification (n, n + 1) or None, floor, share, level)

   Of finite values: the largest accumulated error of an end point, the visible noise, and
   rounding, each relative to the component's size; the last ones of to_legendre (s + 1, s + 1)
   are looked at, `used` of them for tails. */
static PyObject *estimates(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 8))
        return NULL;
    PyArrayObject *H = doubles(&call, 0, 4), *V = H ? doubles(&call, 1, 4) : NULL;
    PyArrayObject *L = V ? doubles(&call, 2, 2) : NULL, *amplified = NULL;
    if (L == NULL)
        return failed(&call);
    const npy_intp used = PyLong_AsSsize_t(given[3]);
    const double floor = PyFloat_AsDouble(given[5]), share = PyFloat_AsDouble(given[6]);
    const double level = PyFloat_AsDouble(given[7]);
    if (PyErr_Occurred())
        return failed(&call);
    const npy_intp K = size(V, 0), s = size(V, 1) - 1, n = size(V, 2), columns = size(V, 3);
    const npy_intp constant = size(H, 0) == 1, C = n * columns, points = s + 1;
    if ((!constant && !same("elements", size(H, 0), K)) || !same("stages", size(H, 1), s) ||
        !same("components", size(H, 2), n) || !same("components", size(H, 3), n) ||
        !same("rows of to_legendre", size(L, 0), points) ||
        !same("columns of to_legendre", size(L, 1), points))
        return failed(&call);
    const npy_intp rows = points < LAST ? points : LAST;
    if (used < 0 || used > rows) {
        PyErr_SetString(PyExc_ValueError, "more Legendre coefficients used than there are");
        return failed(&call);
    }
    if (given[4] != Py_None) {
        amplified = doubles(&call, 4, 2);
        if (amplified == NULL || !same("rows of amplification", size(amplified, 0), n) ||
            !same("columns of amplification", size(amplified, 1), n + 1))
            return failed(&call);
    }
    double found[3], *work = old_scratch(&call, (size_t)(C * (K + 14)));
    if (work == NULL)
        return failed(&call);
    const Ending ending = {
        .K = K,
        .s = s,
        .n = n,
        .columns = columns,
        .used = used,
        .apart = constant ? 0 : s * n * n,
        .H = data(H),
        .V = data(V),
        .to_legendre = data(L),
        .amplified = amplified ? data(amplified) : NULL,
        .floor = floor,
        .share = share,
        .level = level,
        .work = work,
    };
    judge(&ending, found);
    failed(&call); /* gives back what was held */
    return Py_BuildValue("(ddd)", found[0], found[1], found[2]);
}

PyMethodDef collocation_kernels[] = {
    KERNEL(element_maps), KERNEL(merged), KERNEL(chain), KERNEL(estimates), {NULL, NULL, 0, NULL},
};
