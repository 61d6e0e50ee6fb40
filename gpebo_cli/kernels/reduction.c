/* Elimination on the pivots of one time at all others: bounds of singular values, and the
   strangeness-free equations; see structure_numpy.py. */
#include "lanes.h"
#include "structure.h"

/* Where M[rows, columns] is split, and its blocks at LANES times. */
typedef struct {
    const npy_intp *rows, *columns; /* (size,) of M, the pivots first */
    npy_intp rank, a, d;
    const double *Z1;                /* (n, d) */
    Lane *e, *A;                     /* (orders, n, n) scaled; A below one another is N */
    Lane *M11, *M12, *M21, *M22, *X; /* X = M21 M11⁻¹ */
    Lane *N1, *N2;                   /* (rank, n), (a, n): N[rows], N2 becoming Â2 */
    Lane *whole, *inverse;           /* (n, n): [Z1ᵀE; Â2] */
    Lane *Q;                         /* (n, d) orthonormal basis of range(E T) */
    Lane *work;                      /* (max(rank, n))² twice */
    Lane of_M, of_N, of_X, residual, sign;
} Elimination;

/* Arguments place … place + 3, "@z @z %r nd": rows, columns, rank, Z1. */
static Outcome begin(Call *call, int place, const Model *m, Elimination *el)
{
    const npy_intp n = m->n, size = m->size, r = SIZE(r), a = size - r;
    *el = (Elimination){.rank = r, .a = a, .d = n - a, .Z1 = call->in[place + 3]};
    el->rows = call->index[place], el->columns = call->index[place + 1];
    for (npy_intp i = 0; i < size; i++)
        if (el->rows[i] < 0 || el->rows[i] >= size || el->columns[i] < 0 || el->columns[i] >= size)
            return refused("a row or a column of M", i);
    const npy_intp widest = r > n ? r : n;
    const npy_intp sizes[] = {n * size,    n * size,
                              size * size, a * r,
                              r * n,       a * n,
                              n * n,       n * n,
                              n * el->d,   2 * widest * (widest + n + 1)};
    Lane **parts[] = {&el->e,  &el->A,     &el->M11,     &el->X, &el->N1,
                      &el->N2, &el->whole, &el->inverse, &el->Q, &el->work};
    if (!lanes_scratch(call, sizes, parts, LENGTH(sizes)))
        return ERROR;
    el->M12 = el->M11 + r * r, el->M21 = el->M12 + r * a, el->M22 = el->M21 + a * r;
    return DONE;
}

/* The first coefficients at some times, each order times a power of `time` and of `weights`. */
static void load_series(Lane *out, const Series *from, npy_intp orders, npy_intp first,
                        npy_intp used)
{
    for (npy_intp k = 0; k < orders; k++, out += from->entries)
        lanes_load(out, from->at + k * from->order, from->time, from->entries, first, used);
}

/* Rows from … to − 1 and columns left … right − 1 of M[rows, columns]. */
static void block_of(const Model *m, const Elimination *el, npy_intp from, npy_intp to,
                     npy_intp left, npy_intp right, Lane *out)
{
    const npy_intp n = m->n;
    for (npy_intp p = from; p < to; p++)
        for (npy_intp q = left; q < right; q++, out++) {
            const npy_intp i = el->rows[p] / n, j = el->columns[q] / n;
            const npy_intp entry = el->rows[p] % n * n + el->columns[q] % n;
            const double factor = (double)(j + 1);
            if (j > i) {
                memset(out, 0, sizeof(Lane));
                continue;
            }
            const double *e = el->e[(i - j) * n * n + entry];
            EACH(*out)[l] = factor * e[l];
            if (j < i)
                EACH(*out)[l] -= el->A[(i - j - 1) * n * n + entry][l];
        }
}

/* Scaled coefficients and the blocks of M and N at one block of times. */
EVERY_WIDTH static void fill(const Model *m, Elimination *el, npy_intp first, npy_intp used)
{
    const npy_intp n = m->n, size = m->size, r = el->rank;
    double power = 1.0;
    load_series(el->e, &m->E, m->orders, first, used);
    load_series(el->A, &m->A, m->orders, first, used);
    for (npy_intp k = 0; k < m->orders; k++, power *= m->time)
        for (npy_intp i = 0; i < n * n; i++) {
            const double weight = m->rows[i / n] * m->columns[i % n] * power;
            EACH el->e[k * n * n + i][l] *= weight / m->time;
            EACH el->A[k * n * n + i][l] *= weight;
        }
    block_of(m, el, 0, r, 0, r, el->M11);
    block_of(m, el, 0, r, r, size, el->M12);
    block_of(m, el, r, size, 0, r, el->M21);
    block_of(m, el, r, size, r, size, el->M22);
    lanes_norm(el->of_M, el->M11, size * size); /* of all four */
    lanes_norm(el->of_N, el->A, n * size);
    EACH el->of_M[l] += DBL_MIN, el->of_N[l] += DBL_MIN;
    for (npy_intp p = 0; p < size; p++)
        memcpy(p < r ? el->N1 + p * n : el->N2 + (p - r) * n, el->A + el->rows[p] * n,
               n * sizeof(Lane));
}

/* With X in place: the residual [M21 M22] − X [M11 M12], Â2 = N2 − X N1, [Z1ᵀE; Â2] into whole. */
static void eliminate_blocks(const Model *m, Elimination *el)
{
    const npy_intp n = m->n, r = el->rank, a = el->a;
    lanes_multiply(el->M21, r, el->X, r, el->M11, r, a, r, r, SUBTRACT); /* M11 may be singular */
    lanes_multiply(el->M22, a, el->X, r, el->M12, a, a, r, a, SUBTRACT);
    lanes_norm(el->residual, el->M21, a * (r + a));
    lanes_norm(el->of_X, el->X, a * r);
    lanes_multiply(el->N2, n, el->X, r, el->N1, n, a, r, n, SUBTRACT);
    lanes_from_left(el->whole, n, el->Z1, 1, el->d, el->e, el->d, n, n);
    memcpy(el->whole + el->d * n, el->N2, a * n * sizeof(Lane));
}

static void identity(Lane *out, npy_intp n)
{
    lanes_clear(out, n * n);
    for (npy_intp i = 0; i < n; i++)
        EACH out[i * n + i][l] = 1.0;
}

/* The model, pivots -> bounds of the singular values of M, Â2 and E T2, what elimination leaves
   relative to the size of M, and the dynamics Z1ᵀA T; not finite where a block is singular. */
static Outcome bounds(Call *call)
{
    Model m;
    Elimination el;
    if (read_model(call, &m) == ERROR || begin(call, 6, &m, &el) == ERROR)
        return ERROR;
    const npy_intp n = m.n, size = m.size, r = el.rank, a = el.a, d = el.d;
    for (npy_intp first = 0; first < m.times; first += LANES) {
        const npy_intp used = m.times - first < LANES ? m.times - first : LANES;
        Lane of_inverse, determined, of_E, largest = {0};
        fill(&m, &el, first, used);
        Lane *pivots = el.work, *inverse = el.work + r * r;
        memcpy(pivots, el.M11, r * r * sizeof(Lane));
        identity(inverse, r);
        lanes_solve(pivots, inverse, r, r, el.sign);
        lanes_multiply(el.X, r, el.M21, r, inverse, r, a, r, r, SET);
        lanes_norm(of_inverse, inverse, r * r);
        eliminate_blocks(&m, &el);
        identity(el.inverse, n);
        lanes_solve(el.whole, el.inverse, n, n, el.sign);
        lanes_norm(determined, el.inverse, n * n);
        lanes_norm(of_E, el.e, n * n);
        for (npy_intp i = 0; i < n * size; i++)
            EACH largest[l] = larger(fabs(el.A[i][l]), largest[l]);
        for (npy_intp l = 0; l < used; l++) {
            double *bound = call->out[0] + 3 * (first + l);
            const double scale = larger(larger(el.of_M[l], largest[l]), DBL_MIN);
            const double spread = sqrt((double)a + el.of_X[l] * el.of_X[l]);
            bound[0] = r ? 1.0 / (of_inverse[l] * scale) : HUGE_VAL;
            bound[1] = a ? 1.0 / (determined[l] * spread * el.of_N[l]) : HUGE_VAL;
            bound[2] = d ? 1.0 / (determined[l] * (of_E[l] + DBL_MIN)) : HUGE_VAL;
            call->out[1][first + l] = el.residual[l] / scale;
        }
        /* Z1ᵀ A T, T being the first columns of the inverse. */
        Lane *AT = el.whole, *z = el.work;
        lanes_multiply(AT, d, el.A, n, el.inverse, n, n, n, d, SET);
        lanes_from_left(z, d, el.Z1, 1, d, AT, d, n, d);
        lanes_store(call->out[2], z, d, d, 0, d, first, used);
    }
    return DONE;
}

/* B, F, u and θ, for f = B u + F θ. */
typedef struct {
    Series B, F, u, theta;
    npy_intp inputs, unknowns;
    Lane *matrix, *vector, *g; /* of B or F, of u or θ; g (orders, n) */
} Forcing;

/* g_k += Σ_i matrix_i vector_{k−i}. */
static void add_product(const Model *m, Forcing *f, const Series *matrix, const Series *vector,
                        npy_intp width, npy_intp first, npy_intp used)
{
    const npy_intp n = m->n;
    if (width == 0)
        return;
    load_series(f->matrix, matrix, m->orders, first, used);
    load_series(f->vector, vector, m->orders, first, used);
    for (npy_intp i = 0; i < m->orders; i++)
        for (npy_intp k = i; k < m->orders; k++)
            lanes_multiply(f->g + k * n, 1, f->matrix + i * n * width, width,
                           f->vector + (k - i) * width, 1, n, width, 1, ADD);
}

/* g = (f_0, f_1, …) in scaled rows and time, at one block of times. */
static void force(const Model *m, Forcing *f, npy_intp first, npy_intp used)
{
    const npy_intp n = m->n;
    double power = 1.0;
    lanes_clear(f->g, m->size);
    add_product(m, f, &f->B, &f->u, f->inputs, first, used);
    add_product(m, f, &f->F, &f->theta, f->unknowns, first, used);
    for (npy_intp k = 0; k < m->orders; k++, power *= m->time)
        for (npy_intp i = 0; i < n; i++)
            EACH f->g[k * n + i][l] *= power * m->rows[i];
}

/* X = M21 M11⁻¹, by M11ᵀ Xᵀ = M21ᵀ. */
static void multipliers(Elimination *el)
{
    const npy_intp r = el->rank, a = el->a;
    Lane *turned = el->work, *right = el->work + r * r;
    for (npy_intp i = 0; i < r; i++) {
        for (npy_intp k = 0; k < r; k++)
            memcpy(turned + k * r + i, el->M11 + i * r + k, sizeof(Lane));
        for (npy_intp k = 0; k < a; k++)
            memcpy(right + i * a + k, el->M21 + k * r + i, sizeof(Lane));
    }
    lanes_solve(turned, right, r, a, el->sign);
    for (npy_intp k = 0; k < a; k++)
        for (npy_intp i = 0; i < r; i++)
            memcpy(el->X + k * r + i, right + i * a + k, sizeof(Lane));
}

/* [QᵀE; Â2]⁻¹ = [T P], its rows times the states' scales, into inverse, QᵀE into the first rows of
   whole. It comes from that with Z1, judging rows by their own size; `grown` is the norm of what is
   inverted so. With Z1 the equations are E T times those with Q, and nearly lost where range(E T)
   is nearly at a right angle to that of the reference. */
EVERY_WIDTH static void invert(const Model *m, Elimination *el, double *grown)
{
    const npy_intp n = m->n, a = el->a, d = el->d;
    Lane *scales = el->work, *T = el->work, *R = T + n * d, *X = R + d * d, *E1 = el->whole;
    identity(el->inverse, n);
    for (npy_intp i = 0; i < n; i++) {
        Lane *row = el->whole + i * n;
        double *scale = scales[i];
        EACH scale[l] = DBL_MIN;
        for (npy_intp j = 0; j < n; j++)
            EACH scale[l] = larger(fabs(row[j][l]), scale[l]);
        EACH scale[l] = 1.0 / scale[l];
        for (npy_intp j = 0; j < n; j++)
            EACH row[j][l] *= scale[l];
    }
    lanes_solve(el->whole, el->inverse, n, n, el->sign);
    lanes_norm(grown, el->inverse, n * n);
    for (npy_intp i = 0; i < n * n; i++)
        EACH el->inverse[i][l] *= scales[i % n][l];
    lanes_multiply(el->Q, d, el->e, n, el->inverse, n, n, n, d, SET);
    lanes_qr(el->Q, R, X, n, d);
    lanes_multiply(T, d, el->inverse, n, X, d, n, d, d, SET);
    lanes_product(E1, n, el->Q, 1, d, el->e, n, d, n, n, SET);
    lanes_multiply(R, a, E1, n, el->inverse + d, n, d, n, a, SET);
    lanes_multiply(el->inverse + d, n, T, d, R, a, n, d, a, SUBTRACT);
    for (npy_intp i = 0; i < n * n; i++) {
        double *to = el->inverse[i];
        const double *from = i % n < d ? T[i / n * d + i % n] : to;
        const double unit = m->columns[i / n] / (i % n < d ? m->time : 1.0);
        EACH to[l] = from[l] * unit;
    }
}

/* x (rows, columns) to some times of out, times factors of the columns. */
static void hand_over(double *out, Lane *x, npy_intp rows, npy_intp columns, npy_intp first,
                      npy_intp used, const double *factors, double all)
{
    for (npy_intp i = 0; i < rows * columns; i++)
        EACH x[i][l] *= all / factors[i % columns];
    lanes_store(out, x, rows, columns, 0, columns, first, used);
}

/* The equations at a block of times, 0 beyond the limits; constant matrices are of the first. */
static int equations(const Model *m, Elimination *el, Forcing *f, npy_intp first, npy_intp used,
                     npy_intp matrices, double growth, double residual, double *const *out)
{
    const npy_intp n = m->n, r = el->rank, a = el->a, d = el->d;
    Lane grown, *some = el->e, *f1 = el->work, *f2 = f1 + r;
    const npy_intp these = matrices == 1 ? 1 : used, fresh = matrices > 1 || first == 0;
    force(m, f, first, used);
    if (fresh) {
        fill(m, el, first, used);
        multipliers(el);
        eliminate_blocks(m, el);
        invert(m, el, grown);
        for (npy_intp l = 0; l < used; l++)
            if (!(el->residual[l] <= residual * el->of_M[l] && el->of_X[l] <= growth &&
                  grown[l] <= growth))
                return 0;
        hand_over(out[0], el->whole, d, n, first, these, m->columns, m->time);
        lanes_product(some, n, el->Q, 1, d, el->A, n, d, n, n, SET);
        hand_over(out[1], some, d, n, first, these, m->columns, 1.0);
        hand_over(out[3], el->N2, a, n, first, these, m->columns, 1.0);
        lanes_store(out[5], el->inverse, n, n, 0, d, first, these);
    }
    lanes_product(some, 1, el->Q, 1, d, f->g, 1, d, n, 1, SET);
    lanes_store(out[2], some, 1, d, 0, d, first, used);
    for (npy_intp k = 0; k < m->size; k++)
        memcpy(f1 + k, f->g + el->rows[k], sizeof(Lane));
    lanes_multiply(f2, 1, el->X, r, f1, 1, a, r, 1, SUBTRACT);
    lanes_store(out[4], f2, 1, a, 0, a, first, used);
    lanes_clear(some, n);
    lanes_multiply(some, 1, el->inverse + d, n, f2, 1, n, a, 1, SUBTRACT);
    lanes_store(out[6], some, 1, n, 0, n, first, used);
    return 1;
}

/* Raises most (n, n + 1) to by how much relative rounding of the scaled states, and of 1, reaches
   each state through the constraints at one block of times: |last columns of the inverse| times
   the size of the terms of [Â2 | f2], |[N2 g2]| + |X| (|[N1 g1]| + 2 |M11| |M11⁻¹ [N1 g1]|). */
static void amplify(const Model *m, Elimination *el, Forcing *f, npy_intp first, npy_intp used,
                    Lane *room, double *most)
{
    const npy_intp n = m->n, r = el->rank, a = el->a, d = el->d, width = n + 1;
    Lane grown, *terms = room, *through = room + a * width, *pivots = el->work;
    Lane *higher = el->work + r * r;
    fill(m, el, first, used);
    force(m, f, first, used);
    for (npy_intp p = 0; p < m->size; p++) {
        Lane *to = p < r ? higher + p * width : terms + (p - r) * width;
        memcpy(to, p < r ? el->N1 + p * n : el->N2 + (p - r) * n, n * sizeof(Lane));
        memcpy(to + n, f->g + el->rows[p], sizeof(Lane));
    }
    memcpy(pivots, el->M11, r * r * sizeof(Lane));
    memcpy(through, higher, r * width * sizeof(Lane));
    lanes_solve(pivots, higher, r, width, el->sign);
    for (npy_intp i = 0; i < r * width; i++)
        EACH through[i][l] = fabs(through[i][l]), higher[i][l] = fabs(higher[i][l]);
    memcpy(pivots, el->M11, r * r * sizeof(Lane));
    for (npy_intp i = 0; i < r * r; i++)
        EACH pivots[i][l] = 2.0 * fabs(pivots[i][l]);
    lanes_multiply(through, width, pivots, r, higher, width, r, r, width, ADD);
    multipliers(el);
    eliminate_blocks(m, el);
    for (npy_intp i = 0; i < a * r; i++)
        EACH el->X[i][l] = fabs(el->X[i][l]);
    for (npy_intp i = 0; i < a * width; i++)
        EACH terms[i][l] = fabs(terms[i][l]);
    lanes_multiply(terms, width, el->X, r, through, width, a, r, width, ADD);
    invert(m, el, grown);
    for (npy_intp i = 0; i < n * n; i++)
        EACH el->inverse[i][l] = fabs(el->inverse[i][l]);
    lanes_multiply(through, width, el->inverse + d, n, terms, width, n, a, width, SET);
    for (npy_intp i = 0; i < n * width; i++)
        for (int l = 0; l < LANES; l++)
            most[i] = larger(most[i], through[i][l]);
}

/* The model, B, F, u, θ, pivots, at every how many times the amplification is looked at, growth,
   residual -> E1, A1, f1, A2, f2, basis, offset, amplification. */
static Outcome eliminated(Call *call)
{
    Model m;
    Elimination el;
    if (read_model(call, &m) == ERROR || begin(call, 10, &m, &el) == ERROR)
        return ERROR;
    const npy_intp n = m.n, p = SIZE(m), q = SIZE(q), widest = p > q ? p : q, every = SIZE(e);
    if (every < 1 || (SIZE(M) != 1 && SIZE(M) != m.times))
        return refused("times of E and A, or between looks", SIZE(M));
    Forcing f = {.inputs = p, .unknowns = q};
    f.B = series(call, 6, n * p), f.F = series(call, 7, n * q);
    f.u = series(call, 8, p), f.theta = series(call, 9, q);
    const npy_intp wide = el.rank > n ? el.rank : n;
    const npy_intp sizes[] = {m.orders * n * widest, m.orders * widest, m.orders * n,
                              (el.a + wide) * (n + 1)};
    Lane *room, **parts[] = {&f.matrix, &f.vector, &f.g, &room};
    if (!lanes_scratch(call, sizes, parts, LENGTH(sizes)))
        return ERROR;
    for (npy_intp first = 0; first < m.times; first += LANES) {
        const npy_intp used = m.times - first < LANES ? m.times - first : LANES;
        if (!equations(&m, &el, &f, first, used, SIZE(M), call->number[15], call->number[16],
                       call->out))
            return DECLINED;
    }
    double *most = call->out[7];
    memset(most, 0, n * (n + 1) * sizeof(double));
    Series *each[] = {&m.E, &m.A, &f.B, &f.F, &f.u, &f.theta};
    for (int i = 0; i < 6; i++)
        each[i]->time *= every;
    const npy_intp looks = (m.times + every - 1) / every;
    for (npy_intp first = 0; first < looks; first += LANES)
        amplify(&m, &el, &f, first, looks - first < LANES ? looks - first : LANES, room, most);
    for (npy_intp i = 0; i < n * (n + 1); i++)
        if (i % (n + 1) < n) /* rounding of the model's own states, not of the scaled ones */
            most[i] /= m.columns[i % (n + 1)];
    return DONE;
}

const Kernel reduction_kernels[] = {
    {"bounds", MODEL "@z @z %r nd z=v*n a=z-r d=n-a", "N3 N Ndd", bounds},
    {"eliminated",
     "oM?nn oM?nn n n # %v oN?nm oN?nq oN?m oN?q @z @z %r nd %e # # z=v*n a=z-r d=n-a",
     "Mdn Mdn Nd Man Na Mnd Nn nn+", eliminated},
    {NULL, NULL, NULL, NULL},
};
