/* Mixing, the scalar law of DREM for many gains, and how far estimates are from the truth. */
#include "lanes.h"

/* one · other, with a power of two taken out where it would become too small or too large. */
static double times_power(double one, double other, int *exponent)
{
    const double product = one * other;
    if ((fabs(product) > 1e-100 && fabs(product) < 1e100) || one == 0.0 || other == 0.0 ||
        (product != 0.0 && !(isfinite(one) && isfinite(other))))
        return product;
    int first, second;
    const double mantissa = frexp(one, &first) * frexp(other, &second);
    *exponent += first + second;
    return mantissa;
}

/* The determinant whose pivots' reciprocals are on the diagonal of A (p, p), in one lane. */
static double determinant(const Lane *A, npy_intp p, int l, double sign)
{
    int exponent = 0;
    for (npy_intp k = 0; k < p && sign != 0.0; k++) /* what follows a pivot of 0 is no number */
        sign = times_power(sign, 1.0 / A[k * p + k][l], &exponent);
    return exponent ? ldexp(sign, exponent) : sign;
}

#define SMALL_SHARE 1e-13 /* of an entry: a pivot of which no more is left is rounding */

/* (Ω + r)⁻¹𝒴, not finite where rounding decides, in the place of 𝒴 in [Ω | 𝒴] (p, w). */
EVERY_WIDTH static void regularised(Lane *A, const double *r, npy_intp p, npy_intp w)
{
    for (npy_intp k = 0; k < p; k++)
        EACH A[k * w + k][l] += r[l], A[(p + k) * w][l] = SMALL_SHARE * A[k * w + k][l];
    for (npy_intp k = 0; k < p; k++) {
        double *pivot = A[k * w + k], *small = A[(p + k) * w];
        EACH pivot[l] = pivot[l] > small[l] ? 1.0 / pivot[l] : NAN;
        for (npy_intp i = k + 1; i < p; i++) {
            Lane factor, *restrict to = A + i * w, *restrict from = A + k * w;
            EACH factor[l] = from[i][l] * pivot[l];
            for (npy_intp j = i; j < w; j++)
                EACH to[j][l] -= factor[l] * from[j][l];
        }
    }
    for (npy_intp k = p - 1; k >= 0; k--) {
        Lane *x = A + k * w + p;
        lanes_multiply(x, w, A + k * w + k + 1, w, x + w, w, 1, p - k - 1, w - p, SUBTRACT);
        for (npy_intp j = 0; j < w - p; j++)
            EACH x[j][l] *= A[k * w + k][l];
    }
}

/* [Ω | 𝒴] -> Δ = det Ω, η̄ = Ω⁻¹𝒴, ‖Ω‖‖Ω⁻¹‖; η̄ is not finite where Δ = 0. With r η̄ alone. */
static Outcome mixed(Call *call)
{
    const npy_intp N = SIZE(N), p = SIZE(p), c = SIZE(c), w = SIZE(w);
    Lane *values = (Lane *)scratch(call, LANES * (2 * p * w + p * p));
    if (values == NULL)
        return ERROR;
    Lane *omega = values + p * w, *both = omega + p * p;
    for (npy_intp first = 0; first < N; first += LANES) {
        const npy_intp used = N - first < LANES ? N - first : LANES;
        Lane sign, size, inverse;
        lanes_load(values, call->in[0], p * w, p * w, first, used);
        if (call->in[1] != NULL) {
            lanes_load(&size, call->in[1], 1, 1, first, used);
            for (npy_intp l = first; l < first + used; l++)
                call->out[0][l] = call->out[2][l] = NAN;
            regularised(values, size, p, w);
            lanes_store(call->out[1], values, p, w, p, c, first, used);
            continue;
        }
        lanes_clear(both, p * w);
        for (npy_intp i = 0; i < p; i++) {
            memcpy(omega + i * p, values + i * w, p * sizeof(Lane));
            memcpy(both + i * w + p, values + i * w + p, c * sizeof(Lane));
            EACH both[i * w + i][l] = 1.0;
        }
        lanes_norm(size, omega, p * p);
        lanes_solve(omega, both, p, w, sign);
        lanes_store(call->out[1], both, p, w, p, c, first, used);
        for (npy_intp i = 0; i < p; i++)
            memcpy(values + i * p, both + i * w, p * sizeof(Lane));
        lanes_norm(inverse, values, p * p);
        for (int l = 0; l < used; l++) {
            call->out[0][first + l] = determinant(omega, p, l, sign[l]);
            call->out[2][first + l] = size[l] * inverse[l];
        }
    }
    return DONE;
}

#define SMALLEST 1e-300 /* x from which down (1 − e^{−x})/x is 1 */
#define LARGEST 746.0   /* x from which up e^{−x} is 0, which the library finds out slowly */

/* e^{−x} of x = γ length, and (1 − e^{−x})/x; of the first `used` lanes only. */
static void decays(const Lane *gamma, double length, npy_intp gains, npy_intp used, Lane *end,
                   Lane *mean)
{
    for (npy_intp i = 0; i < gains; i++)
        for (npy_intp l = 0; l < used; l++) {
            const double x = gamma[i][l] * length;
            if (x > 0.5) { /* 1 − e^{−x} has all its digits */
                end[i][l] = x < LARGEST ? exp(-x) : 0.0;
                mean[i][l] = (1.0 - end[i][l]) / x;
            } else if (x <= SMALLEST) {
                end[i][l] = mean[i][l] = 1.0;
            } else {
                const double q = expm1(-x);
                end[i][l] = 1.0 + q;
                mean[i][l] = -q / x;
            }
        }
}

/* Steps of the scalar law: their lengths in I, η̄ at their left ends, its change over each and its
   jump at the end of each. */
typedef struct {
    npy_intp count, p, gains;
    const double *length, *left, *change, *jump;
} Steps;

/* Distances (count, p) of η̂ from η̄ at the left ends of all steps from the one at the first. */
EVERY_WIDTH static void follow(const Steps *s, const Lane *gamma, npy_intp used, Lane *end,
                               Lane *mean, Lane *distance)
{
    const npy_intp p = s->p;
    for (npy_intp k = 0; k + 1 < s->count; k++) {
        decays(gamma, s->length[k], s->gains, used, end, mean);
        for (npy_intp j = 0; j < p; j++) {
            const double change = s->change[k * p + j], jump = s->jump[k * p + j];
            const double *decay = end[s->gains == 1 ? 0 : j], *share = mean[s->gains == 1 ? 0 : j];
            const double *before = distance[k * p + j];
            double *after = distance[(k + 1) * p + j];
            EACH after[l] = decay[l] * before[l] + (-share[l] * change - jump);
        }
    }
}

/* lengths (S,), left, change, jump (S, p), step of each time (M,), I from its left end and its
   share in it, η̂ at the start, γ -> η̂; ε₊ = e^{−x} ε − (1 − e^{−x})/x (η̄₊ − η̄), x = γ δI. */
static Outcome stepped_law(Call *call)
{
    const npy_intp S = SIZE(S), M = SIZE(M), p = SIZE(p), g = SIZE(g), w = SIZE(w);
    const Steps steps = {S, p, w, call->in[0], call->in[1], call->in[2], call->in[3]};
    const npy_intp *place = call->index[4];
    for (npy_intp m = 0; m < M; m++)
        if (place[m] < 0 || place[m] >= S)
            return refused("the step of a time", place[m]);
    if ((w != 1 && w != p) || S < 1)
        return refused("gains of a case, or steps", w);
    Lane *gamma = (Lane *)scratch(call, LANES * (3 * w + S * p));
    if (gamma == NULL)
        return ERROR;
    Lane *end = gamma + w, *mean = end + w, *distance = mean + w;
    memset(end, 0, 2 * w * sizeof(Lane));
    for (npy_intp first = 0; first < g; first += LANES) {
        const npy_intp used = g - first < LANES ? g - first : LANES;
        lanes_load(gamma, call->in[8], w, w, first, used);
        lanes_load(distance, call->in[7], call->step[7], p, first, used);
        for (npy_intp j = 0; j < p; j++)
            EACH distance[j][l] -= steps.left[j];
        follow(&steps, gamma, used, end, mean, distance);
        double *eta = call->out[0] + first * M * p;
        for (npy_intp m = 0; m < M; m++) {
            const npy_intp k = place[m] * p;
            decays(gamma, call->in[5][m], w, used, end, mean);
            for (npy_intp j = 0; j < p; j++) {
                const double left = steps.left[k + j];
                const double change = call->in[6][m] * steps.change[k + j];
                const npy_intp gain = w == 1 ? 0 : j;
                for (npy_intp l = 0; l < used; l++)
                    eta[(l * M + m) * p + j] =
                        left + end[gain][l] * distance[k + j][l] + (1.0 - mean[gain][l]) * change;
            }
        }
    }
    return DONE;
}

#define TOGETHER 32 /* times that are brought into lanes at once */

/* Levels of errors, and at which time each was above its own last; NULL if nobody asks. */
typedef struct {
    Lane *level, *last;
} Course;

static inline void note(const Course *course, npy_intp j, const double *error, double time)
{
    if (course->level == NULL)
        return;
    double *restrict last = course->last[j];
    const double *restrict level = course->level[j];
    EACH last[l] = fabs(error[l]) > level[l] ? time : last[l];
}

/* Weighted squares of η̂ − η and x̂ − x at one time, x̂ = offset + gain η̂, in each lane. */
static inline void squares(const Lane *eta, const double *truth, const double *in_eta, npy_intp p,
                           const double *offset, const double *gain, const double *x,
                           const double *in_x, npy_intp n, double time, const Course *course,
                           double *of_eta, double *of_x)
{
    Lane error;
    EACH of_eta[l] = of_x[l] = 0.0;
    for (npy_intp j = 0; j < p; j++) {
        EACH error[l] = eta[j][l] - truth[j];
        note(course, j, error, time);
        if (in_eta[j] != 0.0)
            EACH of_eta[l] += in_eta[j] * error[l] * error[l];
    }
    for (npy_intp i = 0; i < n; i++) {
        if (in_x[i] == 0.0 && course->level == NULL)
            continue;
        EACH error[l] = 0.0;
        for (npy_intp j = 0; j < p; j++)
            EACH error[l] += gain[i * p + j] * eta[j][l];
        EACH error[l] += offset[i] - x[i];
        note(course, p + i, error, time);
        if (in_x[i] != 0.0)
            EACH of_x[l] += in_x[i] * error[l] * error[l];
    }
}

/* The squares of `used` cases η̂ (used, M, p) at M times into (used, M) both. */
EVERY_WIDTH static void errors_of_cases(const Call *call, const double *eta, npy_intp used,
                                        Lane *lanes, const Course *course, double *of_eta,
                                        double *of_x)
{
    const npy_intp M = SIZE(M), p = SIZE(p), n = SIZE(n);
    for (npy_intp from = 0; from < M; from += TOGETHER) {
        const npy_intp now = M - from < TOGETHER ? M - from : TOGETHER;
        lanes_load(lanes, eta + from * p, M * p, now * p, 0, used);
        Lane in_eta[TOGETHER], in_x[TOGETHER];
        for (npy_intp i = 0; i < now; i++) {
            const npy_intp m = from + i;
            squares(lanes + i * p, call->in[1] + m * call->step[1], call->in[2], p,
                    call->in[3] + m * call->step[3], call->in[4] + m * call->step[4],
                    call->in[5] + m * call->step[5], call->in[6], n, (double)m, course, in_eta[i],
                    in_x[i]);
        }
        for (npy_intp l = 0; l < used; l++)
            for (npy_intp i = 0; i < now; i++) {
                of_eta[l * M + from + i] = in_eta[i][l];
                of_x[l * M + from + i] = in_x[i][l];
            }
    }
}

/* The last index at which a course (M,) is above a share of its beginning, −1 for none. */
static double last_above(const double *course, npy_intp M, double share)
{
    npy_intp m = M - 1;
    while (m >= 0 && !(course[m] > share * course[0]))
        m--;
    return (double)m;
}

/* η̂, η, weights (p,), offset, gain, x, weights (n,), levels (g, p + n) or None, a share
   -> Σ weight (η̂ − η)², Σ weight (x̂ − x)², and the last time, as an index, at which each error is
   above its level and each sum above a share of its beginning, −1 for none; what has the weight
   zero may be NaN. */
static Outcome squared_errors(Call *call)
{
    const npy_intp M = SIZE(M), p = SIZE(p), g = SIZE(g), c = SIZE(c);
    Lane *lanes = (Lane *)scratch(call, (TOGETHER * p + 2 * c) * LANES);
    if (lanes == NULL)
        return ERROR;
    Lane *const level = lanes + TOGETHER * p;
    const Course course = {call->in[7] == NULL ? NULL : level, level + c};
    for (npy_intp first = 0; first < g; first += LANES) {
        const npy_intp used = g - first < LANES ? g - first : LANES;
        if (course.level != NULL)
            lanes_load(level, call->in[7], c, c, first, used);
        for (npy_intp j = 0; j < c; j++)
            EACH course.last[j][l] = -1.0;
        errors_of_cases(call, call->in[0] + first * M * p, used, lanes, &course,
                        call->out[0] + first * M, call->out[1] + first * M);
        lanes_store(call->out[2], course.last, 1, c, 0, c, first, used);
        for (npy_intp k = 2 * first; k < 2 * (first + used); k++)
            call->out[3][k] = last_above(call->out[k % 2] + k / 2 * M, M, call->number[8]);
    }
    return DONE;
}

const Kernel law_kernels[] = {
    {"mixed", "Npw |N c=w-p", "N Npc N", mixed},
    {"stepped_law", "S Sp Sp Sp @M M M g?p gw", "gMp", stepped_law},
    {"squared_errors", "gMp M?p p M?n M?np M?n n |gc # c=p+n", "gM gM gc g2", squared_errors},
    {NULL, NULL, NULL, NULL},
};
