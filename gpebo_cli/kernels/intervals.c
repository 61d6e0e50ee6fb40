/* Known functions over cells of time: gpebo_cli/model/expressions/intervals.py and bounds.py. */
#include "program.h"

#define WIDER (4 * DBL_EPSILON)
#define HALF_PI 1.5707963267948966

typedef struct {
    double low, high;
} Interval;

static const Interval anything = {-INFINITY, INFINITY};

/* The interval a little wider, or anything where an end is not a number. */
static inline Interval widened(double low, double high)
{
    if (low != low || high != high)
        return anything;
    return (Interval){low - WIDER * fabs(low) - DBL_MIN, high + WIDER * fabs(high) + DBL_MIN};
}

/* 0 · ∞ is 0: the bound is never reached. */
static inline double times(double x, double y) { return x == 0.0 || y == 0.0 ? 0.0 : x * y; }

/* Plain comparisons: what is not a number has been looked for. */
static inline double lesser(double x, double y) { return x < y ? x : y; }
static inline double greater(double x, double y) { return x > y ? x : y; }

static inline Interval product(Interval a, Interval b)
{
    const double p = times(a.low, b.low), q = times(a.low, b.high);
    const double r = times(a.high, b.low), s = times(a.high, b.high);
    if (p != p || q != q || r != r || s != s)
        return anything;
    return widened(lesser(lesser(p, q), lesser(r, s)), greater(greater(p, q), greater(r, s)));
}

static inline Interval absolute(Interval a)
{
    const double nearest = greater(greater(a.low, -a.high), 0.0);
    return (Interval){nearest, greater(fabs(a.low), fabs(a.high))};
}

static inline Interval square(Interval a)
{
    a = absolute(a);
    return widened(a.low * a.low, a.high * a.high);
}

static inline Interval quotient(Interval a, Interval b)
{
    if (b.low <= 0.0 && b.high >= 0.0)
        return anything;
    return product(a, (Interval){1.0 / b.high, 1.0 / b.low});
}

static Interval raised(Interval a, double r)
{
    if (r == floor(r) && r > 0.0) {
        a = fmod(r, 2.0) == 0.0 ? absolute(a) : a;
        return widened(pow(a.low, r), pow(a.high, r));
    }
    if (r > 0.0)
        return a.high < 0.0 ? anything : widened(pow(fmax(a.low, 0.0), r), pow(a.high, r));
    return a.low > 0.0 ? widened(pow(a.high, r), pow(a.low, r)) : anything;
}

static double slack_of(Interval a) { return 4e-16 * absolute(a).high + 1e-15; }

/* Whether a crest of sin(x + to) at `at`, or one that rounding might have moved, is inside. */
static int crest(Interval a, double slack, double at)
{
    const double first = (a.low - at - slack) / (4 * HALF_PI);
    const double last = (a.high - at + slack) / (4 * HALF_PI);
    return !isfinite(last - first) || ceil(first) <= floor(last);
}

static Interval wave(Interval a, double x, double y, double to)
{
    const double slack = slack_of(a);
    const double low = crest(a, slack, -HALF_PI - to) ? -1.0 : fmin(x, y);
    const double high = crest(a, slack, HALF_PI - to) ? 1.0 : fmax(x, y);
    return widened(low, high);
}

static Interval tangent(Interval a)
{
    const double slack = slack_of(a);
    const double first = (a.low - HALF_PI - slack) / (2 * HALF_PI);
    const double last = (a.high - HALF_PI + slack) / (2 * HALF_PI);
    if (!isfinite(last - first) || floor(first) != floor(last))
        return anything;
    return widened(tan(a.low), tan(a.high));
}

/* Of a function that grows, where it is defined: between `first` and `last`. */
static Interval rising(double (*function)(double), Interval a, double first, double last)
{
    if (a.high < first || a.low > last)
        return anything;
    return widened(function(fmax(a.low, first)), function(fmin(a.high, last)));
}

static double signum(double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : 0.0; }

static inline Interval image(npy_intp what, Interval a, Interval b, int same_row)
{
    switch (what) {
    case ADD: return widened(a.low + b.low, a.high + b.high);
    case SUBTRACT: return widened(a.low - b.high, a.high - b.low);
    case MULTIPLY: return same_row ? square(a) : product(a, b);
    case DIVIDE: return quotient(a, b);
    case MAXIMUM: return (Interval){greater(a.low, b.low), greater(a.high, b.high)};
    case POWER: return raised(a, b.low);
    case GREATER_EQUAL: return (Interval){a.low >= b.low, a.high >= b.low};
    case NEGATIVE: return (Interval){-a.high, -a.low};
    case SQRT: return rising(sqrt, a, 0.0, INFINITY);
    case EXP: return rising(exp, a, -INFINITY, INFINITY);
    case LOG: return rising(log, a, 0.0, INFINITY);
    case SIN: return wave(a, sin(a.low), sin(a.high), 0.0);
    case COS: return wave(a, cos(a.low), cos(a.high), HALF_PI);
    case TAN: return tangent(a);
    case SINH: return rising(sinh, a, -INFINITY, INFINITY);
    case COSH: return rising(cosh, absolute(a), 0.0, INFINITY);
    case TANH: return rising(tanh, a, -INFINITY, INFINITY);
    case ASIN: return rising(asin, a, -1.0, 1.0);
    case ACOS:
        return widened(acos(fmax(-1.0, fmin(1.0, a.high))), acos(fmax(-1.0, fmin(1.0, a.low))));
    case ATAN: return rising(atan, a, -INFINITY, INFINITY);
    case ASINH: return rising(asinh, a, -INFINITY, INFINITY);
    case ACOSH: return rising(acosh, a, 1.0, INFINITY);
    case ATANH: return rising(atanh, a, -1.0, 1.0);
    case ERF: return rising(erf, a, -INFINITY, INFINITY);
    case ABSOLUTE: return absolute(a);
    default: return (Interval){signum(a.low), signum(a.high)};
    }
}

/* Bounds of the results of the code at one cell, whose first two rows are given. What is made of
   `inside` and constants alone is a number, as it is without kernels: what decides has one sign. */
static void run_cell(const Call *call, Interval *row, char *number)
{
    const Operation *operation = (const Operation *)call->index[3];
    const double *constant = call->in[4];
    for (npy_intp k = 0; k < SIZE(v); k++, operation++) {
        const npy_intp left = operation->left, right = operation->right;
        const Interval a = left < 0 ? (Interval){constant[~left], constant[~left]} : row[left];
        const Interval b = right < 0 ? (Interval){constant[~right], constant[~right]} : row[right];
        const Interval found = image(operation->what, a, b, left == right && left >= 0);
        const double middle = found.low + 0.5 * (found.high - found.low);
        const int one = (left < 0 || number[left]) && (right < 0 || number[right]);
        number[GIVEN + k] = one && isfinite(middle);
        row[GIVEN + k] = number[GIVEN + k] ? (Interval){middle, middle} : found;
    }
}

/* low, high, inside, code, constants, rows of the results -> least, most; jumps are decided at
   `inside` where the code says so. */
static Outcome intervals(Call *call)
{
    const npy_intp N = SIZE(N), orders = SIZE(o), outputs = SIZE(j), constants = SIZE(c);
    const npy_intp used = rows_used((const Operation *)call->index[3], SIZE(v), GIVEN, constants);
    if (!used || !results_fit(call->index[5], orders * outputs, used, constants))
        return ERROR;
    Interval *row = (Interval *)scratch(call, 3 * used);
    if (row == NULL)
        return ERROR;
    char *number = (char *)(row + used);
    for (npy_intp i = 0; i < N; i++) {
        row[0] = (Interval){call->in[0][i], call->in[1][i]};
        row[1] = (Interval){call->in[2][i], call->in[2][i]};
        number[0] = 0, number[1] = 1;
        run_cell(call, row, number);
        for (npy_intp k = 0; k < orders * outputs; k++) {
            const npy_intp from = call->index[5][k];
            const npy_intp to = (k / outputs * N + i) * outputs + k % outputs;
            const double x = from < 0 ? call->in[4][~from] : 0.0;
            call->out[0][to] = from < 0 ? (x == x ? x : -INFINITY) : row[from].low;
            call->out[1][to] = from < 0 ? (x == x ? x : INFINITY) : row[from].high;
        }
    }
    return DONE;
}

const Kernel interval_kernels[] = {
    {"intervals", "N N N @v3 c @oj", "oNj oNj", intervals},
    {NULL, NULL, NULL, NULL},
};
