/* gpebo_cli/evidence/excitation.py, regression.py: spectra of small symmetric matrices, windows, the first
   time of excitation. */
#include "stack.h"

#include <float.h>

/* The power of two that brings the largest of some numbers below one; 0 if one is not finite. */
static double unit(const double *A, npy_intp numbers)
{
    double most = 0.0;
    for (npy_intp i = 0; i < numbers; i++) {
        if (!isfinite(A[i]))
            return 0.0;
        most = fabs(A[i]) > most ? fabs(A[i]) : most;
    }
    int exponent = 0;
    frexp(most, &exponent);
    return ldexp(1.0, exponent > 1000 ? -1000 : exponent < -1000 ? 1000 : -exponent);
}

/* A symmetric A (p, p), of which the lower triangle counts and is destroyed, made tridiagonal by
   Householder's reflections, the last row first: diagonal d (p,), beside it e (p,) with e[i]
   between i and i + 1. */
static void tridiagonal(double *restrict A, npy_intp p, double *restrict d, double *restrict e)
{
    for (npy_intp i = p - 1; i > 0; i--) {
        double *restrict v = A + i * p, square = 0.0;
        for (npy_intp k = 0; k < i - 1; k++)
            square += v[k] * v[k];
        if (square == 0.0) { /* nothing to reflect */
            e[i - 1] = v[i - 1];
            continue;
        }
        const double edge = v[i - 1], norm = sqrt(square + edge * edge);
        e[i - 1] = edge >= 0.0 ? -norm : norm;
        v[i - 1] = edge - e[i - 1]; /* reflects along v, with vᵀv = 2 half */
        const double half = norm * (norm + fabs(edge));
        double along = 0.0;
        for (npy_intp j = 0; j < i; j++) {
            double sum = 0.0;
            for (npy_intp k = 0; k <= j; k++)
                sum += A[j * p + k] * v[k];
            for (npy_intp k = j + 1; k < i; k++)
                sum += A[k * p + j] * v[k];
            d[j] = sum / half;
            along += d[j] * v[j];
        }
        along /= 2.0 * half;
        for (npy_intp j = 0; j < i; j++) {
            d[j] -= along * v[j];
            for (npy_intp k = 0; k <= j; k++)
                A[j * p + k] -= v[j] * d[k] + d[j] * v[k];
        }
    }
    for (npy_intp i = 0; i < p; i++)
        d[i] = A[i * p + i];
}

#define STEPS 60 /* for one eigenvalue; two are what it takes */

/* Eigenvalues of the tridiagonal matrix with diagonal d (p,), which they replace, and e (p,)
   beside it, which is destroyed: the QL algorithm with implicit shifts. */
static void tridiagonal_ql(double *restrict d, double *restrict e, npy_intp p)
{
    for (npy_intp low = 0; low < p; low++)
        for (int step = 0; step < STEPS; step++) {
            npy_intp high = low;
            while (high < p - 1 &&
                   fabs(e[high]) > 0.5 * DBL_EPSILON * (fabs(d[high]) + fabs(d[high + 1])))
                high++;
            if (high == low)
                break;
            double g = (d[low + 1] - d[low]) / (2.0 * e[low]), r = sqrt(g * g + 1.0);
            g = d[high] - d[low] + e[low] / (g >= 0.0 ? g + r : g - r);
            double sine = 1.0, cosine = 1.0, shift = 0.0;
            npy_intp i = high - 1;
            for (; i >= low; i--) {
                const double f = sine * e[i], b = cosine * e[i];
                r = sqrt(f * f + g * g);
                if (i < p - 1)
                    e[i + 1] = r;
                if (r == 0.0) {
                    d[i + 1] -= shift;
                    e[high] = 0.0;
                    break;
                }
                const double inverse = 1.0 / r;
                sine = f * inverse;
                cosine = g * inverse;
                g = d[i + 1] - shift;
                r = (d[i] - g) * sine + 2.0 * cosine * b;
                shift = sine * r;
                d[i + 1] = g + shift;
                g = cosine * r - b;
            }
            if (i >= low)
                continue;
            d[low] -= shift;
            e[low] = g;
            e[high] = 0.0;
        }
}

/* Puts a value among the first `count` of `out`, which are ascending. */
static void insert(double *out, npy_intp count, double value)
{
    for (; count > 0 && out[count - 1] > value; count--)
        out[count] = out[count - 1];
    out[count] = value;
}

/* Eigenvalues of the symmetric A (p, p), of which the lower triangle counts, ascending to `out`
   (p,), to rounding in the largest; A is destroyed, `beside` is (p,). 0 if A is not finite. */
static int eigenvalues_of(double *restrict A, npy_intp p, double *restrict out,
                          double *restrict beside)
{
    for (npy_intp i = 0; i < p; i++)
        for (npy_intp j = 0; j < i; j++)
            A[j * p + i] = A[i * p + j];
    const double scale = unit(A, p * p);
    if (scale == 0.0)
        return 0;
    for (npy_intp i = 0; i < p * p; i++)
        A[i] *= scale;
    tridiagonal(A, p, out, beside);
    tridiagonal_ql(out, beside, p);
    const double back = 1.0 / scale; /* a power of two */
    for (npy_intp i = 0; i < p; i++)
        insert(out, i, out[i] * back);
    return 1;
}

#define NEGLIGIBLE 1e-18 /* entries beside a diagonal, of matrices whose largest one is near 1 */

/* Eigenvalues of the symmetric A (p, p) in its diagonal and, in the columns of V (p, p), its
   eigenvectors, by Jacobi's rotations. */
static void rotate_to_diagonal(double *restrict A, double *restrict V, npy_intp p)
{
    for (npy_intp i = 0; i < p * p; i++)
        V[i] = i % (p + 1) == 0;
    int turned = 1;
    for (int sweep = 0; turned && sweep < STEPS; sweep++) {
        turned = 0;
        for (npy_intp i = 1; i < p; i++)
            for (npy_intp j = 0; j < i; j++) {
                const double beside = A[i * p + j];
                if (fabs(beside) <= NEGLIGIBLE)
                    continue;
                turned = 1;
                const double theta = 0.5 * (A[i * p + i] - A[j * p + j]) / beside;
                const double size = 1.0 / (fabs(theta) + sqrt(theta * theta + 1.0));
                const double tangent = theta < 0.0 ? -size : size;
                const double cosine = 1.0 / sqrt(tangent * tangent + 1.0);
                const double sine = tangent * cosine;
                A[j * p + j] -= tangent * beside;
                A[i * p + i] += tangent * beside;
                A[i * p + j] = A[j * p + i] = 0.0;
                for (npy_intp k = 0; k < p; k++) {
                    const double left = V[k * p + j], right = V[k * p + i];
                    V[k * p + j] = cosine * left - sine * right;
                    V[k * p + i] = sine * left + cosine * right;
                    if (k == i || k == j)
                        continue;
                    const double one = A[k * p + j], other = A[k * p + i];
                    A[k * p + j] = A[j * p + k] = cosine * one - sine * other;
                    A[k * p + i] = A[i * p + k] = sine * one + cosine * other;
                }
            }
    }
}

/* A (p, c >= p) -> eigenvalues of the left square, whose lower triangle counts, ascending (p,),
   and the eigenvector (p,) of the first; None if not all is finite. */
static PyObject *eigenvector(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 1))
        return NULL;
    PyArrayObject *A = doubles(&call, 0, 2);
    if (A == NULL)
        return failed(&call);
    const npy_intp p = size(A, 0), c = size(A, 1);
    if (c < p) {
        PyErr_SetString(PyExc_ValueError, "the matrix is narrower than square");
        return failed(&call);
    }
    PyArrayObject *values = fresh(&call, 1, &p);
    PyArrayObject *vector = values == NULL ? NULL : fresh(&call, 1, &p);
    double *square = vector == NULL ? NULL : scratch(&call, 2 * p * p);
    if (square == NULL)
        return failed(&call);
    for (npy_intp i = 0; i < p; i++)
        for (npy_intp j = 0; j <= i; j++)
            square[i * p + j] = square[j * p + i] = data(A)[i * c + j];
    const double scale = unit(square, p * p);
    if (scale == 0.0)
        return no_answer(&call);
    for (npy_intp i = 0; i < p * p; i++)
        square[i] *= scale;
    double *V = square + p * p;
    rotate_to_diagonal(square, V, p);
    npy_intp least = 0;
    for (npy_intp i = 0; i < p; i++) {
        least = square[i * p + i] < square[least * p + least] ? i : least;
        insert(data(values), i, square[i * p + i] / scale);
    }
    for (npy_intp i = 0; i < p; i++)
        data(vector)[i] = V[i * p + least];
    return results(&call, 2, values, vector);
}

/* A (N, p, c >= p) -> eigenvalues of the left squares, whose lower triangles count, ascending
   (N, p); None if not all is finite. */
static PyObject *eigenvalues(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 1))
        return NULL;
    PyArrayObject *A = doubles(&call, 0, 3);
    if (A == NULL)
        return failed(&call);
    const npy_intp N = size(A, 0), p = size(A, 1), c = size(A, 2);
    if (c < p) {
        PyErr_SetString(PyExc_ValueError, "matrices are narrower than square");
        return failed(&call);
    }
    PyArrayObject *out = fresh(&call, 2, (npy_intp[]){N, p});
    double *work = out == NULL ? NULL : scratch(&call, p * p + p);
    if (work == NULL)
        return failed(&call);
    const double *one = data(A);
    for (npy_intp k = 0; k < N; k++, one += p * c) {
        for (npy_intp i = 0; i < p; i++)
            memcpy(work + i * p, one + i * c, p * sizeof(double));
        if (!eigenvalues_of(work, p, data(out) + k * p, work + p * p))
            return no_answer(&call);
    }
    return results(&call, 1, out);
}

/* The left squares (p, p) of Σ_i weights_i values_i to `out`, of values (points, p, c). */
static void combined(double *restrict out, const double *restrict weights,
                     const double *restrict values, npy_intp points, npy_intp p, npy_intp c)
{
    memset(out, 0, p * p * sizeof(double));
    for (npy_intp k = 0; k < points; k++, values += p * c) {
        const double weight = weights[k];
        if (weight != 0.0)
            for (npy_intp i = 0; i < p; i++)
                for (npy_intp j = 0; j < p; j++)
                    out[i * p + j] += weight * values[i * c + j];
    }
}

/* values (K, points, p, c >= p), element (N,), weights (N, points) -> eigenvalues of the left
   squares of the values sampled so, ascending (N, p); None if not all is finite. */
static PyObject *sampled_eigenvalues(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    if (!begin(&call, given, count, 3))
        return NULL;
    PyArrayObject *values = doubles(&call, 0, 4);
    PyArrayObject *element = values == NULL ? NULL : indices(&call, 1, 1);
    PyArrayObject *weights = element == NULL ? NULL : doubles(&call, 2, 2);
    if (weights == NULL || !same("times", size(element, 0), size(weights, 0)) ||
        !same("points", size(values, 1), size(weights, 1)))
        return failed(&call);
    const npy_intp N = size(element, 0), points = size(values, 1), p = size(values, 2);
    const npy_intp c = size(values, 3), *which = (npy_intp *)PyArray_DATA(element);
    int fits = c >= p;
    for (npy_intp k = 0; k < N; k++)
        fits = fits && which[k] >= 0 && which[k] < size(values, 0);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "no such element, or matrices narrower than square");
        return failed(&call);
    }
    PyArrayObject *out = fresh(&call, 2, (npy_intp[]){N, p});
    double *work = out == NULL ? NULL : scratch(&call, p * p + p);
    if (work == NULL)
        return failed(&call);
    for (npy_intp k = 0; k < N; k++) {
        combined(work, data(weights) + k * points, data(values) + which[k] * points * p * c, points,
                 p, c);
        if (!eigenvalues_of(work, p, data(out) + k * p, work + p * p))
            return no_answer(&call);
    }
    return results(&call, 1, out);
}

/* ‖A‖₂ of A (rows, columns), whose rows are `apart`, from the eigenvalues of AᵀA or A Aᵀ, of
   which the largest is exact to rounding. −1 if A is not finite. `work` holds rows · columns +
   m² + 2 m numbers with m = min(rows, columns). */
static double norm_of(const double *A, npy_intp rows, npy_intp columns, npy_intp apart,
                      double *work)
{
    const npy_intp m = rows < columns ? rows : columns, most = rows < columns ? columns : rows;
    double *scaled = work, *square = work + rows * columns, *values = square + m * m;
    if (m == 0)
        return 0.0;
    for (npy_intp i = 0; i < rows; i++)
        memcpy(scaled + i * columns, A + i * apart, columns * sizeof(double));
    const double scale = unit(scaled, rows * columns);
    if (scale == 0.0)
        return -1.0;
    for (npy_intp i = 0; i < rows * columns; i++)
        scaled[i] *= scale;
    const npy_intp along = rows < columns ? 1 : columns, across = rows < columns ? columns : 1;
    for (npy_intp i = 0; i < m; i++)
        for (npy_intp j = 0; j <= i; j++) {
            double sum = 0.0;
            for (npy_intp k = 0; k < most; k++)
                sum += scaled[i * across + k * along] * scaled[j * across + k * along];
            square[i * m + j] = sum;
        }
    eigenvalues_of(square, m, values, values + m);
    return sqrt(values[m - 1] > 0.0 ? values[m - 1] : 0.0) / scale;
}

/* A (…, rows, columns), used -> max over all of the norm ‖·‖₂ of the first `used` columns; None
   if not all is finite. Only matrices whose Frobenius norm exceeds the largest ‖·‖₂ so far are
   looked at. */
static PyObject *spectral_norm(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Stack A;
    npy_intp used;
    if (!begin(&call, given, count, 2))
        return NULL;
    const int axes = PyArray_Check(given[0]) ? PyArray_NDIM((PyArrayObject *)given[0]) : 0;
    if (!stack(&call, 0, axes == 2 ? 1 : 2, &A) || !count_of(&call, 1, &used))
        return failed(&call);
    const npy_intp rows = last(&A, 2), columns = last(&A, 1), N = axes == 2 ? 1 : A.times;
    if (used > columns) {
        PyErr_SetString(PyExc_ValueError, "more columns asked for than there are");
        return failed(&call);
    }
    const npy_intp m = rows < used ? rows : used;
    double *work = scratch(&call, rows * used + m * m + 2 * m);
    if (work == NULL)
        return failed(&call);
    double most = 0.0, frobenius = -1.0;
    npy_intp start = 0; /* where the Frobenius norm is largest: the others have it hard */
    for (int pass = 0; pass < 2; pass++) {
        const double limit = most * most * (1.0 - 1e-12);
        const double *one = A.at;
        for (npy_intp k = 0; k < N; k++, one += rows * columns) {
            double sum = 0.0;
            for (npy_intp i = 0; i < rows; i++)
                for (npy_intp j = 0; j < used; j++)
                    sum += one[i * columns + j] * one[i * columns + j];
            if (!(sum < INFINITY)) { /* squares beyond all numbers, or no numbers */
                const double norm = norm_of(one, rows, used, columns, work);
                if (norm < 0.0)
                    return no_answer(&call);
                most = norm > most ? norm : most;
            } else if (pass == 0) {
                if (sum > frobenius) {
                    frobenius = sum;
                    start = k;
                }
            } else if (k != start && (sum >= limit || limit < 1e-250) && sum >= most * most) {
                const double norm = norm_of(one, rows, used, columns, work);
                most = norm > most ? norm : most;
            }
        }
        if (pass == 0 && frobenius >= 0.0) {
            const double *at = A.at + start * rows * columns;
            const double norm = norm_of(at, rows, used, columns, work);
            most = norm > most ? norm : most;
        }
    }
    return one_number(&call, most);
}

/* injectivity (N,), H (N or 1, n, b) -> [value, place] (2,): the smallest injectivity ‖H‖_F/‖H‖₂
   over all times and where it is, the first of equal ones; None if not all is finite. */
static PyObject *weakest(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    Stack bound, H;
    if (!begin(&call, given, count, 2) || !stack(&call, 0, 0, &bound) || !stack(&call, 1, 2, &H) ||
        !lasting("times of H", &H, bound.times))
        return failed(&call);
    const npy_intp N = bound.times, n = last(&H, 2), b = last(&H, 1), m = n < b ? n : b;
    PyArrayObject *out = zeros(&call, 1, (npy_intp[]){2});
    double *work = out == NULL ? NULL : scratch(&call, n * b + m * m + 2 * m);
    if (work == NULL)
        return failed(&call);
    npy_intp lowest = 0;
    for (npy_intp k = 0; k < N; k++) {
        if (!isfinite(bound.at[k]))
            return no_answer(&call);
        lowest = bound.at[k] < bound.at[lowest] ? k : lowest;
    }
    double limit = INFINITY, value = INFINITY;
    npy_intp place = 0;
    for (npy_intp step = -1; step < N; step++) {
        const npy_intp k = step < 0 ? lowest : step;
        if (N == 0 || (step >= 0 && bound.at[k] > limit))
            continue;
        const double *one = H.at + (H.times == 1 ? 0 : k) * H.numbers;
        const double norm = norm_of(one, n, b, b, work);
        double sum = 0.0;
        for (npy_intp i = 0; i < n * b; i++)
            sum += one[i] * one[i];
        const double exact = bound.at[k] * (sqrt(sum) / norm);
        if (!(norm > 0.0) || !isfinite(exact))
            return no_answer(&call);
        if (step < 0)
            limit = exact > bound.at[k] ? exact : bound.at[k];
        else if (exact < value) {
            value = exact;
            place = k;
        }
    }
    data(out)[0] = value;
    data(out)[1] = (double)place;
    return results(&call, 1, out);
}

/* Barycentric weights (points,) of the place `at` in [0, 1]. */
static void weights_at(double *restrict out, double at, const double *restrict nodes,
                       const double *restrict barycentric, npy_intp points)
{
    double sum = 0.0;
    for (npy_intp i = 0; i < points; i++) {
        const double distance = at - nodes[i];
        if (fabs(distance) < 4.0 * DBL_EPSILON) {
            memset(out, 0, points * sizeof(double));
            out[i] = 1.0;
            return;
        }
        out[i] = barycentric[i] / distance;
        sum += out[i];
    }
    for (npy_intp i = 0; i < points; i++)
        out[i] /= sum;
}

/* What `first_time` looks at: one element of a mesh. */
typedef struct {
    const double *values, *nodes, *barycentric; /* (points, p, c), (points,), (points,) */
    npy_intp points, p, c;
    double left, right;
    double *weights, *matrix, *eigenvalues, *beside; /* (points,), (p, p), (p,), (p,) */
} Element;

/* λ_min of the element's matrix, which is destroyed; NaN if it is not finite. */
static double smallest(const Element *one)
{
    const int found = eigenvalues_of(one->matrix, one->p, one->eigenvalues, one->beside);
    return found ? one->eigenvalues[0] : NAN;
}

/* λ_min of the left squares of the values at a time; NaN if they are not finite. */
static double smallest_at(const Element *one, double t)
{
    weights_at(one->weights, (t - one->left) / (one->right - one->left), one->nodes,
               one->barycentric, one->points);
    combined(one->matrix, one->weights, one->values, one->points, one->p, one->c);
    return smallest(one);
}

/* The same at one of the element's points. */
static double smallest_at_point(const Element *one, npy_intp point)
{
    const double *from = one->values + point * one->p * one->c;
    for (npy_intp i = 0; i < one->p; i++)
        memcpy(one->matrix + i * one->p, from + i * one->c, one->p * sizeof(double));
    return smallest(one);
}

/* values (K, points, p, c >= p), edges (K + 1,), nodes (points,) in [0, 1], barycentric (points,),
   around (a,) ascending, level, rounds, resolution -> the first time at which λ_min of the left
   squares reaches the level, or −inf; None if not all is finite.

   The first element that ends at the level or above, its points, then `rounds` times the secant's
   zero and distances `around` it, in bracket lengths, until the bracket is that short. */
static PyObject *first_time(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    double rho, resolution;
    npy_intp rounds;
    if (!begin(&call, given, count, 8))
        return NULL;
    PyArrayObject *values = doubles(&call, 0, 4);
    PyArrayObject *edges = values == NULL ? NULL : doubles(&call, 1, 1);
    PyArrayObject *nodes = edges == NULL ? NULL : doubles(&call, 2, 1);
    PyArrayObject *barycentric = nodes == NULL ? NULL : doubles(&call, 3, 1);
    PyArrayObject *around = barycentric == NULL ? NULL : doubles(&call, 4, 1);
    if (around == NULL || !number(&call, 5, &rho) || !count_of(&call, 6, &rounds) ||
        !number(&call, 7, &resolution) ||
        !same("elements and edges", size(values, 0) + 1, size(edges, 0)) ||
        !same("points and nodes", size(values, 1), size(nodes, 0)) ||
        !same("points and weights", size(values, 1), size(barycentric, 0)))
        return failed(&call);
    const npy_intp K = size(values, 0), points = size(values, 1), p = size(values, 2);
    const npy_intp c = size(values, 3), near = size(around, 0);
    if (c < p || p == 0 || points == 0 || near == 0) {
        PyErr_SetString(PyExc_ValueError, "nothing to look at");
        return failed(&call);
    }
    const npy_intp room = points > near ? points : near;
    double *memory = scratch(&call, points + p * p + 2 * p + room);
    if (memory == NULL)
        return failed(&call);
    Element one = {
        .values = data(values),
        .nodes = data(nodes),
        .barycentric = data(barycentric),
        .points = points,
        .p = p,
        .c = c,
        .weights = memory,
        .matrix = memory + points,
        .eigenvalues = memory + points + p * p,
        .beside = memory + points + p * p + p,
    };
    double *t = one.beside + p;
    npy_intp k = 0;
    for (; k < K; k++, one.values += points * p * c) {
        const double reached = smallest_at_point(&one, points - 1);
        if (reached != reached)
            return no_answer(&call);
        if (reached >= rho)
            break;
    }
    if (k == K)
        return one_number(&call, -INFINITY);
    one.left = data(edges)[k];
    one.right = data(edges)[k + 1];
    const double horizon = data(edges)[K] - data(edges)[0];
    npy_intp size_of = points;
    for (npy_intp i = 0; i < points; i++)
        t[i] = one.left + (one.right - one.left) * data(nodes)[i];
    t[points - 1] = one.right;
    double high = one.right;
    for (npy_intp round = 0; round < rounds; round++) {
        npy_intp j = 0;
        double before = 0.0, here = 0.0; /* λ_min less the level, at j − 1 and j */
        for (;; j++, before = here) {
            here = (round == 0 ? smallest_at_point(&one, j) : smallest_at(&one, t[j])) - rho;
            if (here != here)
                return no_answer(&call);
            if (here >= 0.0 || j == size_of - 1)
                break;
        }
        if (here < 0.0) /* rounding; it was reached there */
            here = 0.0;
        const double low = t[j > 0 ? j - 1 : 0];
        high = t[j];
        if (high - low <= resolution * (fabs(high) > horizon ? fabs(high) : horizon))
            break;
        const double share = before / (before - here);
        const double guess = low + (high - low) * (share >= 0.0 && share <= 1.0 ? share : 0.5);
        size_of = 0;
        for (npy_intp i = 0; i < near; i++) {
            double at = guess + (high - low) * data(around)[i];
            at = at < low ? low : at > high ? high : at;
            if (size_of == 0 || at > t[size_of - 1])
                t[size_of++] = at;
        }
    }
    return one_number(&call, high);
}

/* out (rows, used; row length used) += factor · values (rows, columns), the first `used` ones. */
static void accumulate(double *restrict out, double factor, const double *restrict values,
                       npy_intp rows, npy_intp columns, npy_intp used)
{
    for (npy_intp i = 0; i < rows; i++)
        for (npy_intp j = 0; j < used; j++)
            out[i * used + j] += factor * values[i * columns + j];
}

/* values (K, s + 1, rows, columns), steps (K,), integration (s, s), used, first (N,), its weights
   (N, s + 1), last (N,), its weights -> (N, rows, used): ∫ of the first `used` columns from the
   place in element `first` to that in element `last`, whole elements summed afresh. */
static PyObject *window_sums(PyObject *module, PyObject *const *given, Py_ssize_t count)
{
    (void)module;
    Call call;
    npy_intp used;
    if (!begin(&call, given, count, 8))
        return NULL;
    PyArrayObject *values = doubles(&call, 0, 4);
    PyArrayObject *steps = values == NULL ? NULL : doubles(&call, 1, 1);
    PyArrayObject *rule = steps == NULL ? NULL : doubles(&call, 2, 2);
    PyArrayObject *ends[2], *weights[2];
    if (rule == NULL || !count_of(&call, 3, &used))
        return failed(&call);
    for (int i = 0; i < 2; i++)
        if ((ends[i] = indices(&call, 4 + 2 * i, 1)) == NULL ||
            (weights[i] = doubles(&call, 5 + 2 * i, 2)) == NULL)
            return failed(&call);
    const npy_intp K = size(values, 0), points = size(values, 1), s = points - 1;
    const npy_intp rows = size(values, 2), columns = size(values, 3), N = size(ends[0], 0);
    if (!same("elements and steps", K, size(steps, 0)) || !same("stages", size(rule, 0), s) ||
        !same("stages", size(rule, 1), s) || !same("times", size(ends[1], 0), N))
        return failed(&call);
    for (int i = 0; i < 2; i++) {
        if (!same("times of the weights", size(weights[i], 0), N) ||
            !same("points of the weights", size(weights[i], 1), points))
            return failed(&call);
        for (npy_intp k = 0; k < N; k++) {
            const npy_intp element = ((npy_intp *)PyArray_DATA(ends[i]))[k];
            if (element < 0 || element >= K) {
                PyErr_SetString(PyExc_ValueError, "no such element");
                return failed(&call);
            }
        }
    }
    if (used > columns) {
        PyErr_SetString(PyExc_ValueError, "more columns asked for than there are");
        return failed(&call);
    }
    const npy_intp numbers = rows * used, element = points * rows * columns;
    PyArrayObject *out = zeros(&call, 3, (npy_intp[]){N, rows, used});
    double *totals = out == NULL ? NULL : scratch(&call, K * numbers + s);
    if (totals == NULL)
        return failed(&call);
    double *share = totals + K * numbers;
    const double *integration = data(rule), *h = data(steps);
    memset(totals, 0, K * numbers * sizeof(double));
    for (npy_intp k = 0; k < K; k++)
        for (npy_intp j = 0; j < s; j++)
            accumulate(totals + k * numbers, h[k] * integration[(s - 1) * s + j],
                       data(values) + k * element + (1 + j) * rows * columns, rows, columns, used);
    for (npy_intp i = 0; i < N; i++) {
        const npy_intp from = ((npy_intp *)PyArray_DATA(ends[0]))[i];
        const npy_intp to = ((npy_intp *)PyArray_DATA(ends[1]))[i];
        double *sum = data(out) + i * numbers;
        for (npy_intp k = from; k < to; k++)
            for (npy_intp j = 0; j < numbers; j++)
                sum[j] += totals[k * numbers + j];
        for (int end = 0; end < 2; end++) {
            const npy_intp k = end ? to : from;
            const double *weight = data(weights[end]) + i * points;
            for (npy_intp j = 0; j < s; j++)
                share[j] = 0.0;
            for (npy_intp a = 0; a < s; a++)
                if (weight[1 + a] != 0.0)
                    for (npy_intp j = 0; j < s; j++)
                        share[j] += weight[1 + a] * integration[a * s + j];
            for (npy_intp j = 0; j < s; j++)
                accumulate(sum, (end ? h[k] : -h[k]) * share[j],
                           data(values) + k * element + (1 + j) * rows * columns, rows, columns,
                           used);
        }
    }
    return results(&call, 1, out);
}

PyMethodDef excitation_kernels[] = {
    KERNEL(eigenvalues), KERNEL(eigenvector), KERNEL(sampled_eigenvalues), KERNEL(spectral_norm),
    KERNEL(weakest),     KERNEL(first_time),  KERNEL(window_sums),         {NULL, NULL, 0, NULL},
};
