/* Derivative arrays at single times: singular values, and where they carry their rank. */
#include "structure.h"

#include "elements.h"
#include "orthogonal.h"

/* What there is to see at one time. */
typedef struct {
    double *e, *a;       /* (orders, n, n) scaled */
    double *M;           /* (size, size) */
    double *W, *mirrors; /* (size, size) */
    double *square;      /* (size, size) */
    double *sigma;       /* (size,) of M, from large to small */
    npy_intp *order;     /* (size,) */
    double *Z2;          /* (a, size) by rows, orthonormal: Z2ᵀ */
    double *A2;          /* (a, n) */
    double *T2;          /* (d, n) by rows: T2ᵀ */
    double *Z1;          /* (d, n) by rows: Z1ᵀ */
    double smallest[3];  /* of M, Â2 and E T2, relative; infinite where there is none */
    npy_intp constraints;
} Look;

/* e and a (orders, n, n): the scaled coefficients at time t. */
static void scaled(const Model *m, npy_intp t, double *e, double *a)
{
    const npy_intp n = m->n;
    double power = 1.0;
    for (npy_intp k = 0; k < m->orders; k++, power *= m->time) {
        const double *E = m->E.at + k * m->E.order + t * m->E.time;
        const double *A = m->A.at + k * m->A.order + t * m->A.time;
        for (npy_intp i = 0; i < n * n; i++) {
            const double weight = m->rows[i / n] * m->columns[i % n];
            *e++ = E[i] * weight * power / m->time;
            *a++ = A[i] * weight * power;
        }
    }
}

/* M (size, size), M_ij = (j + 1) e_{i−j} − a_{i−j−1}, from e and a of one time. */
static void derivative_array(const Model *m, const double *e, const double *a, double *M)
{
    const npy_intp n = m->n, size = m->size;
    memset(M, 0, size * size * sizeof(double));
    for (npy_intp i = 0; i < m->orders; i++)
        for (npy_intp j = 0; j <= i; j++)
            for (npy_intp p = 0; p < n; p++) {
                double *row = M + (i * n + p) * size + j * n;
                const double *of_e = e + ((i - j) * n + p) * n;
                const double *of_a = j < i ? a + ((i - j - 1) * n + p) * n : NULL;
                for (npy_intp q = 0; q < n; q++)
                    row[q] = (double)(j + 1) * of_e[q] - (of_a ? of_a[q] : 0.0);
            }
}

/* Memory for a look at one time after the other; 0 with an exception. */
static int prepare(Call *call, const Model *m, Look *look)
{
    const npy_intp n = m->n, size = m->size, many = size * size;
    double *memory = scratch(call, 2 * n * size + 5 * many + size + 3 * n * n);
    look->order = memory ? (npy_intp *)scratch(call, size) : NULL;
    if (look->order == NULL)
        return 0;
    double **parts[] = {&look->e,       &look->a,      &look->M,  &look->W,
                        &look->mirrors, &look->square, &look->Z2, &look->sigma,
                        &look->A2,      &look->T2,     &look->Z1};
    const npy_intp sizes[] = {n * size, n * size, many,  many,  many, many,
                              many,     size,     n * n, n * n, n * n};
    for (size_t i = 0; i < sizeof(sizes) / sizeof(sizes[0]); memory += sizes[i++])
        *parts[i] = memory;
    return 1;
}

/* Singular values of L (rows, rows) in the upper left of W (…, length), lower triangular: those
   of its columns, which its triangularisation has made almost orthogonal. */
static int triangular_values(const double *W, npy_intp rows, npy_intp length, double *square,
                             double *sigma)
{
    for (npy_intp i = 0; i < rows; i++)
        for (npy_intp j = 0; j < rows; j++)
            square[j * rows + i] = W[i * length + j];
    return orthogonalise(square, rows, rows, sigma);
}

/* Singular values of M, largest first, into sigma; how many rows of W hold more than rounding, or −1
   where numbers overflow. M is used up. */
static npy_intp values_of_M(npy_intp size, Look *look)
{
    memcpy(look->W, look->M, size * size * sizeof(double));
    triangularise(look->W, size, size, look->mirrors, look->order);
    if (!(fabs(look->W[0]) < DBL_MAX)) /* squares that overflow */
        return -1;
    /* Rows of W with nothing left but rounding: the left kernel is perpendicular to the rest. */
    npy_intp rank = 0;
    const double rounding = 4.0 * DBL_EPSILON * (double)size * fabs(look->W[0]);
    while (rank < size && fabs(look->W[rank * size + rank]) > rounding)
        rank++;
    double *columns = look->M; /* (rank, size), the columns of L */
    for (npy_intp i = 0; i < rank; i++)
        for (npy_intp j = 0; j < size; j++)
            columns[i * size + j] = look->W[j * size + i];
    const double noise = rank < size ? fabs(look->W[rank * size + rank]) : 0.0;
    triangularise(columns, rank, size, look->mirrors, NULL);
    if (!triangular_values(columns, rank, size, look->square, look->sigma))
        return -1;
    sort_down(look->sigma, NULL, rank, 0);
    for (npy_intp i = rank; i < size; i++)
        look->sigma[i] = i == rank ? noise : 0.0;
    return rank;
}

static int look_at(const Model *m, npy_intp t, npy_intp constraints, double rank_tol, int upto,
                   Look *look)
{
    const npy_intp n = m->n, size = m->size;
    look->smallest[0] = look->smallest[1] = look->smallest[2] = HUGE_VAL;
    scaled(m, t, look->e, look->a);
    derivative_array(m, look->e, look->a, look->M);
    double largest = 0.0, all = 0.0;
    for (npy_intp i = 0; i < n * size; i++) {
        all += look->a[i] + look->e[i];
        largest = fabs(look->a[i]) > largest ? fabs(look->a[i]) : largest;
    }
    if (!(fabs(all) < DBL_MAX))
        return 0;
    const npy_intp rank = values_of_M(size, look);
    if (rank < 0)
        return 0;
    double scale = look->sigma[0] > largest ? look->sigma[0] : largest;
    scale = scale > DBL_MIN ? scale : DBL_MIN;
    npy_intp counted = 0;
    for (npy_intp i = 0; i < size; i++) {
        look->sigma[i] /= scale;
        counted += look->sigma[i] > rank_tol;
    }
    const npy_intp r = constraints < 0 ? counted : size - constraints, a = size - r;
    look->constraints = a;
    if (a > n || r < 0)
        return a > n && constraints < 0;
    if (r)
        look->smallest[0] = look->sigma[r - 1];
    if (upto < 2)
        return 1;
    if (rank != r)
        return 0;
    columns_of_q(look->mirrors, r, size, r, look->W);
    for (npy_intp i = 0; i < a; i++)
        for (npy_intp j = 0; j < size; j++)
            look->Z2[i * size + look->order[j]] = look->W[i * size + j];
    for (npy_intp i = 0; i < a; i++) /* N is a_0 … a_mu, one below the other */
        combine(look->A2 + i * n, NULL, look->Z2 + i * size, size, look->a, n, n);
    triangularise(look->A2, a, n, look->mirrors, look->order);
    if (!triangular_values(look->A2, a, n, look->square, look->sigma))
        return 0;
    const double of_N = norm(look->a, n * size), of_E = norm(look->e, n * n);
    if (!(of_N < DBL_MAX && of_E < DBL_MAX))
        return 0;
    for (npy_intp i = 0; i < a; i++)
        if (look->sigma[i] / of_N < look->smallest[1])
            look->smallest[1] = look->sigma[i] / of_N;
    if (upto < 3)
        return 1;
    columns_of_q(look->mirrors, a, n, a, look->T2);
    const npy_intp d = n - a;
    for (npy_intp j = 0; j < d; j++)
        for (npy_intp i = 0; i < n; i++)
            look->Z1[j * n + i] = dot(look->e + i * n, look->T2 + j * n, n);
    if (!orthogonalise(look->Z1, d, n, look->sigma))
        return 0;
    sort_down(look->sigma, look->Z1, d, n);
    for (npy_intp j = 0; j < d; j++)
        for (npy_intp i = 0; look->sigma[j] > 0.0 && i < n; i++)
            look->Z1[j * n + i] /= look->sigma[j];
    if (d)
        look->smallest[2] = look->sigma[d - 1] / of_E;
    return 1;
}

/* The model, rank_tol, a number of constraints or −1 -> how many there are, and the smallest
   singular values of M, Â2 and E T2 that count as nonzero, relative to the size of their factors,
   at each time. */
static Outcome levels(Call *call)
{
    Model m;
    Look look;
    if (read_model(call, &m) == ERROR || !prepare(call, &m, &look))
        return ERROR;
    const npy_intp asked = (npy_intp)call->number[7];
    if (asked > m.n)
        return refused("constraints", asked);
    for (npy_intp t = 0; t < m.times; t++) {
        if (!look_at(&m, t, asked, call->number[6], 3, &look))
            return DECLINED;
        call->out[0][t] = (double)look.constraints;
        memcpy(call->out[1] + 3 * t, look.smallest, sizeof(look.smallest));
    }
    return DONE;
}

/* Flags `count` rows and columns of left (size, size) that carry its rank, by elimination with
   complete pivoting. 0 if a pivot is zero. */
static int pivots(double *left, npy_intp size, npy_intp count, npy_intp *rows, npy_intp *columns)
{
    for (npy_intp k = 0; k < count; k++) {
        npy_intp best = 0;
        for (npy_intp i = 1; i < size * size; i++)
            if (fabs(left[i]) > fabs(left[best]))
                best = i;
        const npy_intp p = best / size, q = best % size;
        const double pivot = left[best];
        if (pivot == 0.0)
            return 0;
        rows[p] = columns[q] = 1;
        for (npy_intp i = 0; i < size; i++) {
            const double factor = left[i * size + q] / pivot;
            if (i == p || factor == 0.0)
                continue;
            for (npy_intp j = 0; j < size; j++)
                left[i * size + j] -= factor * left[p * size + j];
            left[i * size + q] = 0.0;
        }
        memset(left + p * size, 0, size * sizeof(double));
    }
    return 1;
}

/* The model, a time, rank_tol -> [constraints], smallest singular values, flags of the rows and
   columns of M that carry its rank, Z1ᵀ in the first rows. */
static Outcome reference(Call *call)
{
    Model m;
    Look look;
    if (read_model(call, &m) == ERROR || !prepare(call, &m, &look))
        return ERROR;
    const npy_intp place = SIZE(p), n = m.n, size = m.size;
    if (place >= m.times)
        return refused("a time", place);
    if (!look_at(&m, place, -1, call->number[7], 3, &look))
        return DECLINED;
    const npy_intp a = look.constraints, d = n - a;
    call->out[0][0] = (double)a;
    memcpy(call->out[1], look.smallest, sizeof(look.smallest));
    memset(call->out[4], 0, n * n * sizeof(double));
    memset(call->index_out[2], 0, size * sizeof(npy_intp));
    memset(call->index_out[3], 0, size * sizeof(npy_intp));
    if (a > n) /* so many that the rest means nothing */
        return DONE;
    memcpy(call->out[4], look.Z1, d * n * sizeof(double));
    derivative_array(&m, look.e, look.a, look.M);
    if (!pivots(look.M, size, size - a, call->index_out[2], call->index_out[3]))
        return DECLINED;
    return DONE;
}

const Kernel structure_kernels[] = {
    {"levels", MODEL "# #", "N N3", levels},
    {"reference", MODEL "%p # z=v*n", "1 3 @z @z nn", reference},
    {NULL, NULL, NULL, NULL},
};
