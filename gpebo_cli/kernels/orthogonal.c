#include "orthogonal.h"

#define SWEEPS 40   /* of Jacobi rotations; a handful suffices */
#define ALMOST 1e-9 /* cosines between rows after which one sweep more leaves none */

void triangularise(double *W, npy_intp rows, npy_intp length, double *mirrors, npy_intp *order)
{
    for (npy_intp k = 0; order && k < rows; k++)
        order[k] = k;
    for (npy_intp k = 0; k < rows; k++) {
        const npy_intp left = length - k;
        if (order) {
            npy_intp best = k;
            double most = -1.0;
            for (npy_intp i = k; i < rows; i++) {
                const double square = dot(W + i * length + k, W + i * length + k, left);
                if (square > most)
                    most = square, best = i;
            }
            if (best != k) {
                swap_rows(W + k * length, W + best * length, length);
                const npy_intp kept = order[k];
                order[k] = order[best];
                order[best] = kept;
            }
        }
        double *row = W + k * length + k, *v = mirrors + k * length;
        memset(v, 0, length * sizeof(double));
        v += k;
        const double length_of_row = sqrt(dot(row, row, left));
        if (length_of_row == 0.0 || left == 1)
            continue;
        const double first = row[0] > 0.0 ? -length_of_row : length_of_row;
        /* v vᵀ with |v|² = 2 */
        const double head = row[0] - first, factor = 1.0 / sqrt(-first * head);
        v[0] = head * factor;
        for (npy_intp j = 1; j < left; j++)
            v[j] = row[j] * factor;
        row[0] = first;
        memset(row + 1, 0, (left - 1) * sizeof(double));
        for (npy_intp i = k + 1; i < rows; i++) {
            double *other = W + i * length + k;
            const double along = dot(other, v, left);
            for (npy_intp j = 0; j < left; j++)
                other[j] -= along * v[j];
        }
    }
}

void columns_of_q(const double *mirrors, npy_intp rows, npy_intp length, npy_intp from, double *out)
{
    for (npy_intp j = from; j < length; j++, out += length) {
        memset(out, 0, length * sizeof(double));
        out[j] = 1.0;
        for (npy_intp k = (j < rows ? j + 1 : rows) - 1; k >= 0; k--) {
            const double *v = mirrors + k * length;
            const double along = dot(out + k, v + k, length - k);
            for (npy_intp i = k; i < length; i++)
                out[i] -= along * v[i];
        }
    }
}

int orthogonalise(double *W, npy_intp rows, npy_intp length, double *sigma)
{
    const double enough = DBL_EPSILON * (double)(length + 1);
    for (int sweep = 0; sweep < SWEEPS; sweep++) {
        double total = 0.0, worst = 0.0;
        for (npy_intp i = 0; i < rows; i++)
            total += sigma[i] = dot(W + i * length, W + i * length, length);
        if (!(total < 1e120) || (total > 0.0 && total < 1e-120))
            return 0; /* products of two squares overflow, or are lost */
        const double rounding = 0.0625 * DBL_EPSILON * DBL_EPSILON * total;
        for (npy_intp p = 0; p < rows; p++)
            for (npy_intp q = p + 1; q < rows; q++) {
                const double one = sigma[p], other = sigma[q];
                if (one <= rounding || other <= rounding)
                    continue;
                double *restrict x = W + p * length, *restrict y = W + q * length;
                const double product = dot(x, y, length);
                const double cosine = fabs(product) / sqrt(one * other);
                if (cosine <= enough)
                    continue;
                if (cosine > worst)
                    worst = cosine;
                const double zeta = (other - one) / (2.0 * product);
                const double sign = zeta >= 0.0 ? 1.0 : -1.0;
                const double t = sign / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
                const double c = 1.0 / sqrt(1.0 + t * t), s = c * t;
                for (npy_intp j = 0; j < length; j++) {
                    const double kept = x[j];
                    x[j] = c * kept - s * y[j];
                    y[j] = s * kept + c * y[j];
                }
                sigma[p] = one - t * product > 0.0 ? one - t * product : 0.0;
                sigma[q] = other + t * product > 0.0 ? other + t * product : 0.0;
            }
        if (worst <= ALMOST) {
            for (npy_intp i = 0; i < rows; i++)
                sigma[i] = sqrt(dot(W + i * length, W + i * length, length));
            return 1;
        }
    }
    return 0;
}

void sort_down(double *sigma, double *W, npy_intp count, npy_intp length)
{
    for (npy_intp i = 1; i < count; i++)
        for (npy_intp k = i; k > 0 && sigma[k] > sigma[k - 1]; k--) {
            swap_rows(sigma + k, sigma + k - 1, 1);
            if (W != NULL)
                swap_rows(W + k * length, W + (k - 1) * length, length);
        }
}
