/* Systems of elements, chaining; see elements_numpy.py. */
#include "elements.h"

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
    const double *h;  /* lengths (K,) */
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
            combine(q->taken, NULL, at(q->E, point) + a * n, n, slope, columns, columns);
            for (npy_intp c = 0; c < columns; c++)
                right[c] -= q->taken[c];
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

/* The elements `members` of one length and, if there are several, constant E, A and T: one system
   for all, with the response to the left end and all particular solutions; 0 if it is singular. */
static int solve_group(const Equation *q, const npy_intp *members, npy_intp count, double *W,
                       double *homogeneous, double *particular)
{
    const npy_intp m = q->s * q->d, n = q->n, columns = q->columns, sides = n + count * columns;
    const npy_intp length = row_length(m, sides);
    for (npy_intp i = 0; i < m; i++)
        memset(W + i * length + m + sides, 0, (length - m - sides) * sizeof(double));
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

/* Responses of groups, numbered as they first appear, to left ends, and particular solutions. */
static Outcome element_maps(Call *call)
{
    const npy_intp K = SIZE(K), s = SIZE(s), d = SIZE(d), n = SIZE(n), columns = SIZE(c);
    const npy_intp groups = SIZE(g), m = s * d, *group = call->index[7];
    Equation q = {.s = s, .d = d, .n = n, .columns = columns, .D = call->in[0], .h = call->in[1]};
    Moving *to[] = {&q.E, &q.A, &q.f, &q.T, &q.p};
    for (int i = 0; i < 5; i++)
        *to[i] = (Moving){call->in[2 + i], call->step[2 + i]};
    if ((q.T.from == NULL) != (q.p.from == NULL) || (q.T.from == NULL && d != n) ||
        (q.T.from != NULL && q.E.from == NULL))
        return refused("constraints without an offset or E, or rows", d);
    npy_intp *members = (npy_intp *)scratch(call, K + groups), most = 1;
    if (members == NULL)
        return ERROR;
    if (SIZE(P) != 1 && SIZE(P) != K * (s + 1))
        return refused("points of all elements", SIZE(P));
    npy_intp *sizes = memset(members + K, 0, groups * sizeof(npy_intp));
    for (npy_intp k = 0; k < K; k++) {
        if (group[k] < 0 || group[k] >= groups)
            return refused("a group", group[k]);
        most = ++sizes[group[k]] > most ? sizes[group[k]] : most;
    }
    const npy_intp length = row_length(m, n + most * columns);
    q.together = scratch(call, (n + 1) * m + s * n * columns + d * d + s * s + columns);
    double *W = q.together ? scratch(call, m * length) : NULL;
    if (W == NULL)
        return ERROR;
    q.coupling = q.together + n * m;
    q.slope = q.coupling + m;
    q.AT = q.slope + s * n * columns;
    q.Dh = q.AT + d * d;
    q.taken = q.Dh + s * s;
    for (npy_intp g = 0, first = 0; g < groups; g++, first = 0) {
        npy_intp found = 0;
        while (first < K && (groups == K ? first < g : group[first] != g))
            first++;
        for (npy_intp k = first; k < K && found < sizes[g]; k++)
            if (group[k] == g)
                members[found++] = k;
        if (found &&
            !solve_group(&q, members, found, W, call->out[0] + g * s * n * n, call->out[1]))
            return DECLINED;
    }
    return DONE;
}

/* out (rows, columns) = a (rows, n) x (n, columns) + b (rows, columns). */
static inline void affine(double *out, const double *a, const double *x, const double *b,
                          npy_intp rows, npy_intp n, npy_intp columns)
{
    for (npy_intp i = 0; i < rows; i++)
        combine(out + i * columns, b + i * columns, a + i * n, n, x, columns, columns);
}

/* Maps, particular solutions, start -> values, and how many elements in front are finite. */
EVERY_WIDTH static Outcome chain(Call *call)
{
    const npy_intp s = SIZE(s), n = SIZE(n), c = SIZE(c), block = n * c;
    const double *state = call->in[2];
    double *out = call->out[0], whole = 0.0;
    for (npy_intp k = 0; k < SIZE(K); k++, out += (s + 1) * block) {
        memcpy(out, state, block * sizeof(double));
        affine(out + block, call->in[0] + k * call->step[0], out, call->in[1] + k * s * block,
               s * n, n, c);
        double none = 0.0; /* but where a number is not finite */
        for (npy_intp i = 0; i < (s + 1) * block; i++)
            none += 0.0 * out[i];
        whole += whole == (double)k && none == 0.0;
        state = out + s * block;
    }
    call->out[1][0] = whole;
    return DONE;
}

/* What element k adds to the errors, kinds (2, C); raises most (4, C), see elements_numpy.py. */
EVERY_WIDTH static void own_errors(const Call *call, npy_intp k, double *shown, double *most,
                                   double *kinds)
{
    const npy_intp t = SIZE(t), n = SIZE(n), c = SIZE(c), C = n * c, rows = t < 4 ? t : 4;
    const double *values = call->in[0] + k * t * C, *last = call->in[3] + k * call->step[3];
    const double *alone = call->in[4] + k * call->step[4];
    const double *noise = call->in[5] + k * call->step[5], stages = (double)(t - 1);
    double *size = shown + rows * C;
    memset(size, 0, C * sizeof(double));
    enlarge(size, values, t, C);
    last_coefficients(shown, call->in[1] + (t - rows) * t, values, rows, t, C);
    for (npy_intp e = 0; e < C; e++) {
        const npy_intp i = e / c, b = e % c;
        double share = 0.0, made_of = fabs(alone[e]), rounding = noise[i * (n + c) + n + b];
        double pairs[2] = {0.0, 0.0};
        for (npy_intp j = 0, power = SIZE(u) - rows; j < rows; j++, power++) {
            const double one = shown[j * C + e] / larger(size[e], DBL_MIN);
            pairs[j / 2] = larger(pairs[j / 2], shown[j * C + e]);
            if (power >= 0 && !(one <= share)) /* else its power is not above it either */
                share = larger(share, one >= 1.0 ? 1.0 : pow(one, call->in[2][power]));
        }
        for (npy_intp j = 0; j < n; j++) {
            made_of += fabs(last[i * n + j]) * fabs(values[j * c + b]);
            rounding += noise[i * (n + c) + j] * size[j * c + b];
        }
        const int visible = rows == 4 && pairs[1] >= call->number[7] * pairs[0];
        const double found[] = {size[e] * share, size[e], visible ? pairs[1] : 0.0, made_of};
        for (npy_intp m = 0; m < 4; m++)
            most[m * C + e] = larger(most[m * C + e], found[m]);
        kinds[e] = found[0] * pow(share, 0.5 - 0.5 / stages);
        kinds[C + e] = DBL_EPSILON * (call->number[8] * made_of + rounding);
    }
}

/* How far errors are carried through the elements; see elements_numpy.py. */
static Outcome carried_errors(Call *call)
{
    const npy_intp K = SIZE(K), n = SIZE(n), c = SIZE(c), C = n * c, S = SIZE(w) / 2, N = 2 * n * S;
    const double *sign = call->in[6];
    double *kinds = scratch(call, 7 * C + 3 * N * c), *most = call->out[1];
    if (K < 1)
        return refused("elements", K);
    if (kinds == NULL)
        return ERROR;
    double *shown = kinds + 2 * C, *error = shown + 5 * C, *added = error + N * c;
    double *next = added + N * c;
    const double most_factor = call->number[9];
    memset(most, 0, 5 * C * sizeof(double));
    for (npy_intp i = 0; i < N * c; i++)
        error[i] = i / c / S % 2
                       ? sign[i / c] * DBL_EPSILON * fabs(call->in[0][i / c / S / 2 * c + i % c])
                       : 0.0;
    for (npy_intp k = 0; k < K; k++) {
        own_errors(call, k, shown, most + C, kinds);
        sign += N;
        for (npy_intp i = 0; i < N * c; i++)
            added[i] = sign[i / c] * kinds[i / c / S % 2 * C + i / c / S / 2 * c + i % c];
        affine(next, call->in[3] + k * call->step[3], error, added, n, n, 2 * S * c);
        memcpy(error, next, N * c * sizeof(double));
        for (npy_intp e = 0; e < C; e++) {
            double sum[2] = {0.0, 0.0};
            for (npy_intp s = 0; s < 2 * S; s++) {
                const double one = error[(e / c * 2 * S + s) * c + e % c];
                sum[s / S] += one * one;
            }
            const double factor = (double)(k + 2),
                         other = factor < most_factor ? factor : most_factor;
            const double found = sqrt(sum[0] * (factor / S)) + sqrt(sum[1] * (other / S));
            call->out[0][k * C + e] = found;
            most[e] = larger(most[e], found);
        }
    }
    return DONE;
}

#define MOST_STAGES 16 /* of a rule */
#define MOST_ORDERS 48 /* of a series */
#define AT_ONCE 8      /* columns: their sums are in registers, and their series in the cache */
typedef double Columns[AT_ONCE], Nodes[MOST_STAGES]; /* zeros after the last stage */
#define EACH_NODE _Pragma("omp simd") for (int n = 0; n < MOST_STAGES; n++)
/* Not unrolled before they are vectorised: else sums are kept in memory, at twice the time. */
#define EACH_COLUMN _Pragma("omp simd") for (int b = 0; b < AT_ONCE; b++)
#define EACH_OF_WIDTH _Pragma("omp simd") for (int b = 0; b < width; b++)
#define MAXIMUM(a, b) ((a) > (b) ? (a) : (b)) /* or b where a is no number */

/* X' = A X + f in a part of an element, d rows and some of the columns. */
typedef struct {
    npy_intp d, columns, forced, stride;  /* forced columns of them, of f's rows of `stride` */
    npy_intp degrees, orders;             /* how many powers of the time A and f have */
    npy_intp width, below, later;         /* of a row of terms, and to the row below, later terms */
    const npy_intp *row, *column;         /* of the entries of A */
    const double *A, *f, *decay, *weight; /* (e, degrees), (orders, d, stride), (degrees,), (d,) */
    double h, tol, share, *size, *change; /* these two in units, (d,) */
    double *terms;                        /* the first ones are the left end */
} Part;

/* The largest size of some numbers. */
INLINE double largest_size(const double *x, npy_intp count)
{
    double size = 0.0;
    _Pragma("omp simd reduction(max:size)") for (npy_intp b = 0; b < count; b++) size =
        MAXIMUM(fabs(x[b]), size);
    return size;
}

/* The largest change of the rows, relative to each row's size so far or a share of all. */
INLINE double largest_change(const Part *q)
{
    const double least = larger(q->share * largest_size(q->size, q->d), DBL_MIN);
    double found = 0.0;
    _Pragma("omp simd reduction(max:found)") for (npy_intp i = 0; i < q->d; i++) found =
        MAXIMUM(q->change[i] / MAXIMUM(q->size[i], least), found);
    return found;
}

/* The next term of all rows from so many of the last ones; constant widths make it fast. */
INLINE void next_term(const Part *q, npy_intp k, npy_intp known, const int width)
{
    const npy_intp d = q->d, later = q->later;
    const double *last = q->terms + k * later, factor = q->h / (double)(k + 1);
    for (npy_intp i = 0; i < d; i++) {
        Columns sum = {0.0}, more = {0.0}; /* one alone would wait for each product */
        double *next = q->terms + (k + 1) * later + i * q->below;
        for (npy_intp b = 0; k < q->orders && b < q->forced; b++)
            sum[b] = q->f[(k * d + i) * q->stride + b];
        for (npy_intp e = q->row[i]; e < q->row[i + 1]; e++) {
            const double *x = last + q->column[e] * q->below, *A = q->A + e * q->degrees;
            npy_intp j = 0;
            for (; j + 2 <= known; j += 2, x -= 2 * later) {
                const double one = A[j], other = A[j + 1], *y = x - later;
                EACH_OF_WIDTH sum[b] += one * x[b];
                EACH_OF_WIDTH more[b] += other * y[b];
            }
            if (j < known)
                EACH_OF_WIDTH sum[b] += A[j] * x[b];
        }
        EACH_OF_WIDTH next[b] = factor * (sum[b] + more[b]);
        q->change[i] = q->weight[i] * largest_size(next, width);
        q->size[i] = MAXIMUM(q->change[i], q->size[i]);
    }
}

/* How many terms (k + 1) X_{k+1} = h (Σ A_j X_{k−j} + f_k) until none to follow counts, or 0. */
EVERY_WIDTH static npy_intp expanded(const Part *q)
{
    double size[MOST_ORDERS] = {1.0};
    for (npy_intp k = 0; k + 1 < MOST_ORDERS && size[k] <= DBL_MAX; k++) {
        const npy_intp known = k < q->degrees ? k + 1 : q->degrees;
        double bound = k + 1 < q->orders ? INFINITY : 0.0;
        if (q->width == 1)
            next_term(q, k, known, 1);
        else
            next_term(q, k, known, AT_ONCE);
        size[k + 1] = largest_change(q);
        for (npy_intp j = 0; j < q->degrees && j <= k + 1; j++)
            bound = larger(q->decay[j] * size[k + 1 - j], bound);
        if (bound <= q->tol)
            return k + 2;
    }
    return 0;
}

/* Puts up to AT_ONCE of so many numbers somewhere, all of them in one step. */
INLINE void put(double *to, const double *from, npy_intp count)
{
    if (count >= AT_ONCE)
        memcpy(to, from, sizeof(Columns));
    else
        memcpy(to, from, count * sizeof(double));
}

/* The sums of so many terms at some times, one `apart` from the other, rows one `next` to it; and
   in the place of the first term at the last of all times. */
EVERY_WIDTH static void summed(const Part *q, npy_intp count, const Nodes times, npy_intp some,
                               npy_intp all, double *out, npy_intp apart, npy_intp next)
{
    Nodes power[MOST_ORDERS];
    const npy_intp rows = q->width == 1 ? AT_ONCE : 1; /* in a vector */
    for (npy_intp k = 0; k < count; k++)
        EACH_NODE power[k][n] = k ? power[k - 1][n] * times[n] : 1.0;
    for (npy_intp i = 0; i < q->d; i += rows) {
        const npy_intp left = rows > 1 ? q->d - i : q->columns;
        for (npy_intp j = 0; j < all; j += 4) {
            Columns sum[4] = {{0.0}};
            double *x = q->terms + i * q->below;
            for (npy_intp k = 0; k < count; k++)
                for (int m = 0; m < 4; m++)
                    EACH_COLUMN sum[m][b] += power[k][j + m] * x[k * q->later + b];
            for (int m = 0; m < 4 && j + m < some; m++)
                put(out + (j + m) * apart + i * next, sum[m], left);
            if (j + 4 >= all)
                put(x, sum[all - 1 - j], left);
        }
    }
}

/* All parts of element k from the left end in the terms: X at the nodes, and the right end in its
   place; 0 if a series does not converge. */
static int through_element(const Call *call, Part *q, npy_intp k, npy_intp part, npy_intp first,
                           double *out)
{
    const npy_intp s = SIZE(s), d = q->d, all = SIZE(c), parts = call->index[2][k];
    const double *nodes = call->in[0];
    int converged = 1;
    q->h = call->in[1][k] / (double)parts;
    for (npy_intp i = 0, node = 0, some = 0; i < parts; i++, node += some, some = 0) {
        Nodes times = {0.0};
        q->A = call->in[5] + part * call->step[5];
        q->decay = call->in[6] + part * call->step[6];
        q->f = call->in[7] + first + part++ * call->step[7];
        const double *left = q->terms;
        for (npy_intp r = 0; r < d; r++, left += q->below)
            q->size[r] = q->weight[r] * largest_size(left, q->width);
        const npy_intp count = expanded(q);
        converged &= count > 0;
        for (; node + some < s && (i + 1 == parts || nodes[node + some] * parts <= i + 1); some++)
            times[some] = nodes[node + some] * parts - i;
        const npy_intp known = some > 0 && times[some - 1] == 1.0 ? some : some + 1;
        times[known - 1] = 1.0;
        summed(q, count, times, some, known, out + node * d * all, d * all, all);
    }
    return converged;
}

/* X' = A X + f over all elements by series; see elements_numpy.py. */
static Outcome series(Call *call)
{
    const npy_intp K = SIZE(K), s = SIZE(s), d = SIZE(d), entries = SIZE(e), all = SIZE(c);
    const npy_intp *parts = call->index[2], *row = call->index[3], *column = call->index[4];
    npy_intp sum = 0;
    for (npy_intp k = 0; k < K; sum += parts[k++])
        if (parts[k] < 1)
            return refused("parts", parts[k]);
    if (s < 1 || s > MOST_STAGES || call->in[0][s - 1] != 1.0 || SIZE(f) > all ||
        (SIZE(P) != 1 && SIZE(P) != sum))
        return refused("stages, columns, or parts of all elements", SIZE(P));
    for (npy_intp i = 0; i <= d; i++)
        if (row[i] < (i ? row[i - 1] : 0) || row[i] > entries)
            return refused("a row's first entry", row[i]);
    for (npy_intp e = 0; e < entries; e++)
        if (column[e] < 0 || column[e] >= d)
            return refused("a column", column[e]);
    const npy_intp width = all > 1 ? AT_ONCE : 1, length = width * MOST_ORDERS * d;
    Part q = {.d = d, .stride = SIZE(f), .degrees = SIZE(g), .orders = SIZE(u), .row = row};
    q.width = width, q.below = all > 1 ? AT_ONCE * MOST_ORDERS : 1, q.later = all > 1 ? AT_ONCE : d;
    q.column = column, q.weight = call->in[10], q.tol = call->number[11];
    q.share = call->number[12], q.size = scratch(call, length + 2 * d + 2 * AT_ONCE);
    if (q.size == NULL)
        return ERROR;
    q.change = q.size + d;
    q.terms = q.change + d; /* in whole lines of the cache; vectors reach beyond the last */
    q.terms += (64 - (uintptr_t)q.terms % 64) % 64 / sizeof(double);
    for (npy_intp k = 0; k < K; k++)
        call->out[1][k] = call->number[11];
    for (npy_intp first = 0; first < all; first += AT_ONCE) {
        const npy_intp c = all - first < AT_ONCE ? all - first : AT_ONCE, left = SIZE(f) - first;
        q.columns = c, q.forced = left < 0 ? 0 : left < c ? left : c;
        memset(q.terms, 0, length * sizeof(double));
        for (npy_intp i = 0; i < d; i++)
            memcpy(q.terms + i * q.below, call->in[9] + i * all + first, c * sizeof(double));
        for (npy_intp k = 0, part = 0; k < K; part += parts[k++]) {
            double *out = call->out[0] + k * (s + 1) * d * all + first;
            for (npy_intp i = 0; i < d; i++)
                put(out + i * all, q.terms + i * q.below, c);
            if (!through_element(call, &q, k, part, first, out + d * all))
                call->out[1][k] = INFINITY;
            for (npy_intp i = 0; i < d && call->in[8] != NULL; i++)
                for (npy_intp b = 0; b < c; b++)
                    q.terms[i * q.below + b] += call->in[8][(k * d + i) * all + first + b];
        }
    }
    return DONE;
}

/* D/h ⊗ I − A of an element: full blocks of s rows, transposed, and diagonal ones behind them. */
typedef struct {
    npy_intp s, full;
    Nodes *block, *diagonal;
} Blocks;

/* to += B by. */
INLINE void apply(const Blocks *q, npy_intp place, const double *by, double *to)
{
    const double *row = place < q->full ? q->block[place * q->s] : q->diagonal[place - q->full];
    Nodes sum;
    EACH_NODE sum[n] = to[n];
    for (npy_intp j = 0; place < q->full && j < q->s; j++, row += MOST_STAGES)
        EACH_NODE sum[n] += by[j] * row[n];
    if (place >= q->full)
        EACH_NODE sum[n] += by[n] * row[n];
    EACH_NODE to[n] = sum[n];
}

/* A block's inverse in its place, by row pivots; not finite where there is none. */
INLINE void invert(Nodes *a, npy_intp s)
{
    npy_intp other[MOST_STAGES];
    for (npy_intp k = 0; k < s; k++) {
        Nodes factor = {0.0}, row;
        for (npy_intp i = 0; i < s; i++) { /* at once: a row just written to is slow to read */
            factor[i] = a[i][k];
            a[i][k] = 0.0;
        }
        double most = fabs(factor[k]);
        for (npy_intp i = other[k] = k; i < s; i++)
            if (fabs(factor[i]) > most)
                most = fabs(factor[other[k] = i]);
        EACH_NODE row[n] = a[other[k]][n];
        row[k] = 1.0;
        EACH_NODE row[n] *= 1.0 / factor[other[k]];
        memcpy(a[other[k]], a[k], sizeof(Nodes));
        factor[other[k]] = factor[k];
        for (npy_intp i = 0; i < s; i++)
            EACH_NODE a[i][n] -= factor[i] * row[n];
        memcpy(a[k], row, sizeof(Nodes));
    }
    for (npy_intp k = s - 1; k >= 0; k--)
        for (npy_intp i = 0; i < s && other[k] != k; i++)
            swap_rows(a[i] + k, a[i] + other[k], 1);
}

/* Eliminates in element k: inverts pivots, and adds products left · pivot · right to blocks. */
EVERY_WIDTH static void factorise(const Call *call, const Blocks *q, npy_intp k)
{
    const npy_intp s = q->s, d = SIZE(d), *from = call->index[2], *step = call->index[3];
    Nodes slopes[MOST_STAGES + 1] = {{0.0}};
    for (npy_intp i = 0; i < s; i++) {
        const double *A = call->in[5] + (k * (s + 1) + 1 + i) * call->step[5];
        for (npy_intp e = 0; e < SIZE(e); e++)
            q->diagonal[e][i] = A[e];
        for (npy_intp j = 0; j < s; j++)
            slopes[i][j] = call->in[0][j * s + i] / call->in[1][k];
    }
    for (npy_intp r = 0; r < q->full * s; r++) {
        const npy_intp own = r < d * s, e = from[r / s], i = r % s;
        memcpy(q->block[r], slopes[own ? i : s], sizeof(Nodes));
        if (e >= 0)
            q->block[r][i] += own ? -q->diagonal[e][i] : q->diagonal[e][i];
    }
    for (npy_intp m = 0; m < SIZE(o); m++, step += 4) {
        const npy_intp right = step[3] - q->full;
        Nodes *to = q->block + step[0] * s, *pivot = q->block + step[2] * s;
        if (to == pivot)
            invert(to, s);
        for (npy_intp i = 0; i < s && to != pivot; i++) {
            Nodes row = {0.0}, sum = {0.0};
            if (right < 0)
                apply(q, step[2], q->block[step[3] * s + i], row);
            else
                EACH_NODE row[n] = q->diagonal[right][i] * pivot[i][n];
            apply(q, step[1], row, sum);
            EACH_NODE to[i][n] += step[0] < d ? -sum[n] : sum[n];
        }
    }
}

/* Solves one element after the other by elimination; see elements_numpy.py. */
EVERY_WIDTH static Outcome stiff(Call *call)
{
    const npy_intp K = SIZE(K), s = SIZE(s), d = SIZE(d), c = SIZE(c), forced = SIZE(f);
    const npy_intp B = SIZE(B), all = B + SIZE(e), size = d * c, width[] = {1, 4, 3};
    const npy_intp count[] = {B, SIZE(o), SIZE(m)}, step = call->step[6];
    const npy_intp limit[][4] = {{SIZE(e)}, {B, all, B, all}, {d, d, all}};
    for (int i = 0; i < 3; i++)
        for (npy_intp m = 0; m < count[i] * width[i]; m++)
            if (call->index[2 + i][m] < -!i || call->index[2 + i][m] >= limit[i][m % width[i]])
                return refused("an index", call->index[2 + i][m]);
    if (s > MOST_STAGES || forced > c || B < d || (SIZE(P) != 1 && SIZE(P) != K * (s + 1)) ||
        (SIZE(Q) != 1 && SIZE(Q) != K * (s + 1)))
        return refused("stages, columns, blocks, or points of all elements", s);
    const npy_intp rows = B * s + SIZE(e) + 2 * size;
    Blocks q = {s, B, (Nodes *)scratch(call, rows * MOST_STAGES + size), NULL};
    if (q.block == NULL)
        return ERROR;
    Nodes *b = memset(q.block, 0, rows * sizeof(Nodes)), *x = b + rows - size, slope = {0.0};
    double *state = memcpy(b + rows, call->in[8], size * sizeof(double));
    q.diagonal = b + B * s;
    b = x - size;
    for (npy_intp i = 0; i < s * s; i++)
        slope[i / s] += call->in[0][i];
    for (npy_intp k = 0; k < K; k++) {
        double *out = call->out[0] + k * (s + 1) * size;
        const double *f = call->in[6] + (k * (s + 1) + 1) * step, h = call->in[1][k];
        if (k == 0 || call->step[5] || h != call->in[1][k - 1])
            factorise(call, &q, k);
        memcpy(out, state, size * sizeof(double));
        memset(x, 0, size * sizeof(Nodes));
        for (npy_intp i = 0; i < size; i++)
            for (npy_intp j = 0; j < s; j++)
                b[i][j] = slope[j] / h * state[i] +
                          (i % c < forced ? f[j * step + i / c * forced + i % c] : 0.0);
        for (npy_intp m = 0; m < SIZE(m) * c; m++) {
            const npy_intp *now = call->index[4] + m / c * 3;
            double *to = b[now[0] * c + m % c];
            if (now[0] != now[1]) {
                apply(&q, now[2], x[now[1] * c + m % c], to);
                continue;
            }
            apply(&q, now[2], to, x[now[0] * c + m % c]);
            memset(to, 0, sizeof(Nodes));
        }
        for (npy_intp i = 0; i < size; i++) {
            for (npy_intp j = 0; j < s; j++)
                out[(j + 1) * size + i] = x[i][j];
            state[i] = x[i][s - 1] + (call->in[7] ? call->in[7][k * size + i] : 0.0);
        }
    }
    return DONE;
}

const Kernel element_kernels[] = {
    {"element_maps", "ss K |P?dn P?dn P?dc |P?nd |P?nc @K %g", "gsnn Ksnc", element_maps},
    {"chain", "K?snn Ksnc nc", "Ks+nc 1", chain},
    {"carried_errors", "Ktnc tt u K?nn K?nc K?nv K+nw # # # v=n+c", "Knc 5nc", carried_errors},
    {"series", "s K @K @d+ @e P?eg P?g P?udf |Kdc dc d # #", "Ks+dc K", series},
    {"stiff", "ss K @B @o4 @m3 P?e Q?df |Kdc dc", "Ks+dc", stiff},
    {NULL, NULL, NULL, NULL},
};
