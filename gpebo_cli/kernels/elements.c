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

/* The elements `members` of one length and, if there are several, constant E, A and T: one system
   for all, with the response to the left end and all particular solutions; 0 if it is singular. */
static int solve_group(const Equation *q, const npy_intp *members, npy_intp count, double *W,
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

/* D, h, E, A, f, T, p, the group of each element (ascending from 0 as they first appear), how many
   there are -> responses to the left end of each group, particular solutions. */
static Outcome element_maps(Call *call)
{
    const npy_intp K = SIZE(K), s = SIZE(s), d = SIZE(d), n = SIZE(n), columns = SIZE(c);
    const npy_intp groups = SIZE(g), m = s * d, *group = call->index[7];
    Moving at_points[5];
    for (int i = 0; i < 5; i++)
        at_points[i] = (Moving){call->in[2 + i], call->step[2 + i]};
    Equation q = {.s = s,
                  .d = d,
                  .n = n,
                  .columns = columns,
                  .D = call->in[0],
                  .h = call->in[1],
                  .E = at_points[0],
                  .A = at_points[1],
                  .f = at_points[2],
                  .T = at_points[3],
                  .p = at_points[4]};
    if ((q.T.from == NULL) != (q.p.from == NULL) || (q.T.from == NULL && d != n) ||
        (q.T.from != NULL && q.E.from == NULL))
        return refused("constraints without an offset or E, or rows", d);
    npy_intp *members = scratch_indices(call, K + groups), most = 1;
    if (members == NULL)
        return ERROR;
    if (SIZE(P) != 1 && SIZE(P) != K * (s + 1))
        return refused("points of all elements", SIZE(P));
    npy_intp *sizes = members + K;
    memset(sizes, 0, groups * sizeof(npy_intp));
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

/* Whether all numbers are finite. */
static inline int all_finite(const double *values, npy_intp count)
{
    int bad = 0;
    for (npy_intp i = 0; i < count; i++)
        bad |= !(fabs(values[i]) <= DBL_MAX);
    return !bad;
}

/* Values (K, s + 1, n, columns) ; returns how many elements in front are finite. */
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

/* Maps of the elements (or one for all), particular solutions, start -> values at the points, and
   how many elements in front are finite. */
static Outcome chain(Call *call)
{
    call->out[1][0] = (double)link_up(call->out[0], call->in[0], call->step[0], call->in[1],
                                      call->in[2], SIZE(K), SIZE(s), SIZE(n), SIZE(c));
    return DONE;
}

const Kernel element_kernels[] = {
    {"element_maps", "ss K |P?dn P?dn P?dc |P?nd |P?nc @K %g", "gsnn Ksnc", element_maps},
    {"chain", "K?snn Ksnc nc", "Ks+nc 1", chain},
    {NULL, NULL, NULL, NULL},
};
