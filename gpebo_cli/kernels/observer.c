/* The observer's matrices where kernel and range of E do not turn, and its regression; see
   observer_numpy.py. */
#include "lanes.h"

/* Matrices at LANES times; "all" rows are those of the algebraic equations and the outputs. */
typedef struct {
    npy_intp n, m, q, r, d, b, e, all, width;
    const double *rows, *scale, *domain, *range, *kernel, *equations;
    Lane *E, *A, *B, *F, *C;        /* (n, n), (n, n), (n, m), (n, q), (r, n) */
    Lane *Q, *R, *X;                /* of UᵀE B: (d, d) each */
    Lane *pinv, *Lambda, *LH;       /* (d, n), (d, n), (d, b) */
    Lane *algebraic, *through;      /* (all, n), (all, d + q + m + r): 𝒜 B | G | g_signals */
    Lane *Q1, *R1, *X1, *H;         /* (all, b), (b, b), (b, b), (n, b) */
    Lane *whole, *seen, *work;      /* (d, width), (b, width), (n, n + e + d) */
    double outside, inner, inverse; /* so far the largest */
} Frame;

/* The largest of the entries and `so_far`; NaN stays. */
static double largest(double so_far, const Lane *values, npy_intp entries)
{
    for (npy_intp i = 0; i < entries; i++)
        for (int l = 0; l < LANES; l++)
            so_far = larger(so_far, larger(fabs(values[i][l]), 0.0));
    return so_far;
}

/* Divides the rows of a matrix by their sizes, or multiplies them by them. */
static void scale_rows(Lane *A, npy_intp rows, npy_intp columns, const double *sizes, int divide)
{
    for (npy_intp i = 0; i < rows; i++)
        for (npy_intp j = 0; sizes[i] != 1.0 && j < columns; j++)
            EACH A[i * columns + j][l] *= divide ? 1.0 / sizes[i] : sizes[i];
}

/* E⁺ = B (UᵀE B)⁻¹ Uᵀ, and whether E is what the frame says. */
static void invert_in_frame(Frame *f)
{
    const npy_intp n = f->n, d = f->d, b = f->b;
    Lane size;
    lanes_from_right(f->work, b, f->E, f->kernel, n, n, b);
    lanes_from_left(f->work + n * b, n, f->equations, n, 1, f->E, f->e, n, n);
    f->outside = largest(f->outside, f->work, n * b + f->e * n);
    lanes_from_left(f->work, n, f->range, 1, d, f->E, d, n, n);
    lanes_from_right(f->Q, d, f->work, f->domain, d, n, d);
    lanes_norm(size, f->Q, d * d);
    f->inner = largest(f->inner, &size, 1);
    lanes_qr(f->Q, f->R, f->X, d, d);
    lanes_norm(size, f->X, d * d);
    f->inverse = largest(f->inverse, &size, 1);
    lanes_clear(f->work, d * n); /* Qᵀ Uᵀ */
    for (npy_intp i = 0; i < n; i++)
        for (npy_intp k = 0; k < d; k++)
            for (npy_intp j = 0; j < d && f->range[i * d + k] != 0.0; j++)
                EACH f->work[j * n + i][l] += f->range[i * d + k] * f->Q[k * d + j][l];
    lanes_multiply(f->pinv, n, f->X, d, f->work, n, d, d, n, SET);
}

/* 𝒜 = [Π A; C], 𝒜 B, and Q1, H of (𝒜 Q)⁺ = H Q1ᵀ; the bound of its smallest singular value. */
static void eliminate_kernel(Frame *f, double *bound)
{
    const npy_intp n = f->n, b = f->b, all = f->all;
    Lane norm, inverse;
    lanes_from_left(f->algebraic, n, f->equations, n, 1, f->A, f->e, n, n);
    memcpy(f->algebraic + f->e * n, f->C, f->r * n * sizeof(Lane));
    lanes_from_right(f->through, f->width, f->algebraic, f->domain, all, n, f->d);
    lanes_from_right(f->Q1, b, f->algebraic, f->kernel, all, n, b);
    lanes_qr(f->Q1, f->R1, f->X1, all, b);
    lanes_from_left(f->H, b, f->kernel, b, 1, f->X1, n, b, b);
    lanes_norm(norm, f->algebraic, all * n);
    lanes_norm(inverse, f->X1, b * b);
    EACH bound[l] = b ? 1.0 / (inverse[l] * larger(norm[l], DBL_MIN)) : INFINITY;
}

/* G and g_signals, right of 𝒜 B. */
static void drive(Frame *f)
{
    const npy_intp n = f->n, width = f->width;
    for (npy_intp i = 0; i < f->all; i++)
        lanes_clear(f->through + i * width + f->d, width - f->d);
    lanes_from_left(f->through + f->d, width, f->equations, n, 1, f->F, f->e, n, f->q);
    lanes_from_left(f->through + f->d + f->q, width, f->equations, n, 1, f->B, f->e, n, f->m);
    for (npy_intp i = 0; i < f->r; i++)
        EACH f->through[(f->e + i) * width + f->d + f->q + f->m + i][l] = -f->scale[i];
}

/* [A_0 | D_0 | of u and y] = [Λ B | E⁺F | E⁺B, 0] − Λ H Q1ᵀ [𝒜 B | G | g_signals]. */
static void combine_all(Frame *f)
{
    const npy_intp n = f->n, d = f->d, b = f->b, width = f->width;
    lanes_multiply(f->Lambda, n, f->pinv, n, f->A, n, d, n, n, SET);
    lanes_multiply(f->LH, b, f->Lambda, n, f->H, b, d, n, b, SET);
    lanes_clear(f->whole, d * width);
    lanes_from_right(f->whole, width, f->Lambda, f->domain, d, n, d);
    lanes_multiply(f->whole + d, width, f->pinv, n, f->F, f->q, d, n, f->q, ADD);
    lanes_multiply(f->whole + d + f->q, width, f->pinv, n, f->B, f->m, d, n, f->m, ADD);
    lanes_product(f->seen, width, f->Q1, 1, b, f->through, width, b, f->all, width, SET);
    lanes_multiply(f->whole, width, f->LH, b, f->seen, width, d, b, width, SUBTRACT);
}

static int prepare(Call *call, Frame *f)
{
    const npy_intp n = f->n, d = f->d, b = f->b, all = f->all, width = f->width;
    const npy_intp sizes[] = {
        n * n, n * n,   n * f->m,    n * f->q,  f->r * n,
        d * d, d * d,   d * d,       d * n,     d * n,
        d * b, all * n, all * width, all * b,   b * b,
        b * b, n * b,   d * width,   b * width, n * (n + f->e + d),
    };
    Lane **parts[] = {&f->E,  &f->A,    &f->B,      &f->F,     &f->C,         &f->Q,       &f->R,
                      &f->X,  &f->pinv, &f->Lambda, &f->LH,    &f->algebraic, &f->through, &f->Q1,
                      &f->R1, &f->X1,   &f->H,      &f->whole, &f->seen,      &f->work};
    return lanes_scratch(call, sizes, parts, LENGTH(sizes));
}

/* E, A, B, F, C, sizes of the rows, √w of the outputs, domain, range, kernel, equations, and how
   many times there are of E⁺, of 𝒜, of G and of the dynamics -> see observer_numpy.py. */
static Outcome in_frame(Call *call)
{
    Frame f = {.rows = call->in[5], .scale = call->in[6], .domain = call->in[7]};
    f.range = call->in[8], f.kernel = call->in[9], f.equations = call->in[10];
    f.n = SIZE(n), f.m = SIZE(m), f.q = SIZE(q), f.r = SIZE(r), f.d = SIZE(d), f.b = SIZE(b);
    f.e = SIZE(e), f.all = SIZE(i), f.width = SIZE(d) + SIZE(q) + SIZE(k);
    const npy_intp N = SIZE(N), n = f.n, k = f.m + f.r, all = f.all, width = f.width;
    const npy_intp times[] = {SIZE(x), SIZE(y), SIZE(z), SIZE(w)};
    for (int i = 0; i < 4; i++)
        if (times[i] != 1 && times[i] != N)
            return refused("times", times[i]);
    if (all < f.b)
        return refused("rows for the kernel's columns", all);
    if (!prepare(call, &f))
        return ERROR;
    Lane *const to[] = {f.E, f.A, f.B, f.F, f.C};
    const npy_intp columns[] = {n, n, f.m, f.q, n};
    for (npy_intp first = 0; first < N; first += LANES) {
        const npy_intp used = N - first < LANES ? N - first : LANES;
        npy_intp now[4]; /* how many of these times each of the results has */
        for (int i = 0; i < 4; i++)
            now[i] = times[i] > 1 ? used : first == 0;
        for (int i = 0; i < 5; i++) {
            const npy_intp rows = i < 4 ? n : f.r;
            lanes_load(to[i], call->in[i], call->step[i], rows * columns[i], first, used);
            scale_rows(to[i], rows, columns[i], i < 4 ? f.rows : f.scale, i < 4);
        }
        if (now[0])
            invert_in_frame(&f);
        if (now[1]) {
            Lane bound;
            eliminate_kernel(&f, bound);
            lanes_store(call->out[8], &bound, 1, 1, 0, 1, first, now[1]);
        }
        if (now[2])
            drive(&f);
        combine_all(&f);
        lanes_store(call->out[1], f.pinv, f.d, n, 0, n, first, now[0]);
        lanes_store(call->out[2], f.algebraic, all, n, 0, n, first, now[1]);
        lanes_store(call->out[3], f.through, all, width, 0, f.d, first, now[1]);
        lanes_store(call->out[4], f.through, all, width, f.d + f.q, k, first, now[2]);
        lanes_store(call->out[5], f.through, all, width, f.d, f.q, first, now[2]);
        lanes_store(call->out[6], f.Q1, all, f.b, 0, f.b, first, now[1]);
        lanes_store(call->out[7], f.H, n, f.b, 0, f.b, first, now[1]);
        lanes_store(call->out[9], f.whole, f.d, width, 0, f.d, first, now[3]);
        lanes_store(call->out[10], f.whole, f.d, width, f.d, f.q, first, used);
        lanes_store(call->out[11], f.whole, f.d, width, f.d + f.q, k, first, used);
    }
    memcpy(call->out[0], (double[]){f.outside, f.inner, f.inverse}, 3 * sizeof(double));
    return DONE;
}

/* z, q, basis, 𝒜B, g_y, G, Q1, H -> Y, ψ, offset, gain, sizes of the terms of Y and of the columns
   of ψ before they cancel. */
static Outcome regression_signals(Call *call)
{
    const npy_intp N = SIZE(N), k = SIZE(k), columns = SIZE(p) + 1, q = SIZE(q), n = SIZE(n);
    const npy_intp rows = SIZE(i), b = SIZE(b);
    if (columns < 1 + q)
        return refused("unknowns", q);
    const npy_intp sizes[] = {k * columns,    0,           0,          rows * k,
                              rows,           rows * q,    rows * b,   n * b,
                              rows * columns, b * columns, n * columns};
    Lane *at[LENGTH(sizes)], **parts[LENGTH(sizes)];
    for (size_t i = 0; i < LENGTH(sizes); i++)
        parts[i] = at + i;
    if (!lanes_scratch(call, sizes, parts, LENGTH(sizes)))
        return ERROR;
    Lane *z = at[0], *G = at[5], *Q1 = at[6], *terms = at[8], *seen = at[9], *state = at[10];
    double *most = call->out[4];
    memset(most, 0, columns * sizeof(double));
    for (npy_intp first = 0; first < N; first += LANES) {
        const npy_intp used = N - first < LANES ? N - first : LANES;
        for (int i = 0; i < 8; i++)
            if (i != 1 && i != 2)
                lanes_load(at[i], call->in[i], call->step[i], sizes[i], first, used);
        for (npy_intp i = 0; i < k; i++) /* w = ξ_a + ξ_b θ − Φ e₀ and ψ has −ξ_b, +Φ */
            for (npy_intp j = 1; j < 1 + q; j++)
                EACH z[i * columns + j][l] = -z[i * columns + j][l];
        lanes_multiply(terms, columns, at[3], k, z, columns, rows, k, columns, SET);
        for (npy_intp i = 0; i < rows; i++) {
            Lane *row = terms + i * columns;
            for (npy_intp j = 0; j < columns; j++) {
                Lane direct = {0.0}, whole;
                if (j < 1 + q)
                    EACH direct[l] = j == 0 ? at[4][i][l] : -G[i * q + j - 1][l];
                EACH whole[l] = fabs(direct[l]);
                for (npy_intp c = 0; c < k; c++)
                    EACH whole[l] += fabs(at[3][i * k + c][l] * z[c * columns + j][l]);
                EACH row[j][l] += direct[l];
                most[j] = largest(most[j], &whole, 1);
            }
        }
        lanes_product(seen, columns, Q1, 1, b, terms, columns, b, rows, columns, SET);
        lanes_multiply(terms, columns, Q1, b, seen, columns, rows, b, columns, SUBTRACT);
        lanes_from_left(state, columns, call->in[2], k, 1, z, n, k, columns);
        lanes_multiply(state, columns, at[7], b, seen, columns, n, b, columns, SUBTRACT);
        for (npy_intp i = 0; i < n; i++)
            for (npy_intp j = 1; j < columns; j++)
                EACH state[i * columns + j][l] = -state[i * columns + j][l];
        lanes_store(call->out[0], terms, rows, columns, 0, 1, first, used);
        lanes_store(call->out[1], terms, rows, columns, 1, columns - 1, first, used);
        lanes_store(call->out[2], state, n, columns, 0, 1, first, used);
        lanes_store(call->out[3], state, n, columns, 1, columns - 1, first, used);
    }
    return DONE;
}

const Kernel observer_kernels[] = {
    {"in_frame", "N?nn N?nn N?nm N?nq N?rn n r nd nd nb en %x %y %z %w i=e+r k=m+r",
     "3 xdn yin yid zik ziq yib ynb y wdd Ndq Ndk", in_frame},
    {"regression_signals", "N?kp+ %q nk N?ik N?i N?iq N?ib N?nb", "Ni Nip Nn Nnp p+",
     regression_signals},
    {NULL, NULL, NULL, NULL},
};
