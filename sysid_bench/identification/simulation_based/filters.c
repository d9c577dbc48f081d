/* Kalman filters on the state [q v beta] of n joints: all samples of one pass.
 *
 * The model predicts q and v and is given as a function; beta (r) is constant, so that its block of
 * the covariance changes with measurements alone. Rows are contiguous, and inner loops add a row to
 * another one, which compilers turn into vectors.
 */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#include "../../vectors.h"

enum { DONE, SINGULAR, DIVERGED, INDEFINITE }; /* the first three as the model's */

/* States (count, n) of one beta and their derivatives (count, n, 2 n + r) one sample after `at`. */
typedef int64_t (*Sensitivities)(const void *tree, const void *model, int64_t count,
                                 const int64_t *at, const double *beta, double *q, double *v,
                                 double *dq, double *dv, double *inverse, void *memory);

/* States (count, 2 n + r) one sample after sample k: q and v (count, 2 n). */
typedef int64_t (*Predict)(const void *tree, const void *model, int64_t count, int64_t k,
                           const double *states, double *moved, double *inverse, void *memory);

/* Measured positions q (samples, n) with their noise, noise of the torques (n), and the model. */
typedef struct {
    int64_t n, r, samples;
    double dt;
    const double *q, *q_noise, *tau_noise;
    const void *tree, *model;
    void *step, *step_memory;
} Filter;

/* y (m) += by x (m). */
static inline void add_row(int64_t m, double by, const double *restrict x, double *restrict y)
{
    for (int64_t c = 0; c < m; c++)
        y[c] += by * x[c];
}

/* U (m, m) of U' U = A, in place above the diagonal; 0 unless A is positive definite. */
static int factorise(int64_t m, double *A)
{
    for (int64_t k = 0; k < m; k++) {
        double *own = A + k * m;
        if (!(own[k] > 0.0))
            return 0;
        const double scale = 1.0 / sqrt(own[k]);
        for (int64_t c = k; c < m; c++)
            own[c] *= scale;
        for (int64_t i = k + 1; i < m; i++)
            add_row(m - i, -own[i], own + i, A + i * m + i);
    }
    return 1;
}

static void symmetrise(int64_t m, double *P)
{
    for (int64_t i = 0; i < m; i++)
        for (int64_t c = 0; c < i; c++)
            P[i * m + c] = P[c * m + i] = 0.5 * (P[i * m + c] + P[c * m + i]);
}

/* Measurement update of mean (m) and P (m, m) with the positions of sample k, in Joseph's form,
 * which stays positive semidefinite: (1 - G H) P loses that to rounding. */
static int measure(const Filter *f, int64_t k, double *mean, double *P, double *work)
{
    const int64_t n = f->n, m = 2 * n + f->r;
    double *S = work, *G = S + n * n; /* G: gain, transposed (n, m) */
    for (int64_t i = 0; i < n; i++) {
        memcpy(S + i * n, P + i * m, 8 * (size_t)n);
        memcpy(G + i * m, P + i * m, 8 * (size_t)m);
        S[i * n + i] += f->q_noise[i] * f->q_noise[i];
    }
    if (!factorise(n, S))
        return 0;
    for (int64_t i = 0; i < n; i++) {
        for (int64_t l = 0; l < i; l++)
            add_row(m, -S[l * n + i], G + l * m, G + i * m);
        for (int64_t c = 0; c < m; c++)
            G[i * m + c] /= S[i * n + i];
    }
    for (int64_t i = n - 1; i >= 0; i--) {
        for (int64_t l = i + 1; l < n; l++)
            add_row(m, -S[i * n + l], G + l * m, G + i * m);
        for (int64_t c = 0; c < m; c++)
            G[i * m + c] /= S[i * n + i];
    }
    double *T = G + n * m, *seen = T + m * m, *innovation = seen + n * m;
    for (int64_t i = 0; i < n; i++)
        innovation[i] = f->q[k * n + i] - mean[i];
    for (int64_t i = 0; i < n; i++)
        add_row(m, innovation[i], G + i * m, mean);
    /* T = (1 - G H) P, then P = T (1 - G H)' + G R G'. */
    memcpy(T, P, 8 * (size_t)(m * m));
    memcpy(seen, P, 8 * (size_t)(n * m));
    for (int64_t i = 0; i < m; i++)
        for (int64_t l = 0; l < n; l++)
            add_row(m, -G[l * m + i], seen + l * m, T + i * m);
    for (int64_t i = 0; i < m; i++) {
        double *row = T + i * m, first[n];
        memcpy(first, row, sizeof first);
        for (int64_t l = 0; l < n; l++) {
            const double noise = f->q_noise[l] * f->q_noise[l];
            add_row(m, noise * G[l * m + i] - first[l], G + l * m, row);
        }
    }
    memcpy(P, T, 8 * (size_t)(m * m));
    symmetrise(m, P);
    return 1;
}

/* Add the covariance of torque noise that is held over one sample: it moves v by dt M^-1 w, and q by
 * half of dt times that. */
static void add_noise(const Filter *f, const double *inverse, double *P)
{
    const int64_t n = f->n, m = 2 * n + f->r;
    const double of_v = f->dt, of_q = 0.5 * f->dt * f->dt;
    for (int64_t i = 0; i < n; i++)
        for (int64_t c = 0; c < n; c++) {
            double sum = 0.0;
            for (int64_t l = 0; l < n; l++)
                sum += inverse[i * n + l] * inverse[c * n + l] * f->tau_noise[l] * f->tau_noise[l];
            P[i * m + c] += of_q * of_q * sum;
            P[i * m + n + c] += of_q * of_v * sum;
            P[(n + i) * m + c] += of_v * of_q * sum;
            P[(n + i) * m + n + c] += of_v * of_v * sum;
        }
}

/* P = F P F', F (2 n, m) above the unit rows of beta. */
static void propagate(int64_t states, int64_t m, const double *F, double *P, double *work)
{
    double *FP = work, *T = FP + states * m;
    memset(FP, 0, 8 * (size_t)(states * m));
    for (int64_t i = 0; i < states; i++)
        for (int64_t l = 0; l < m; l++)
            add_row(m, F[i * m + l], P + l * m, FP + i * m);
    for (int64_t l = 0; l < m; l++) /* F', so that rows are contiguous */
        for (int64_t i = 0; i < states; i++)
            T[l * states + i] = F[i * m + l];
    for (int64_t i = 0; i < states; i++) {
        double *row = P + i * m;
        memset(row, 0, 8 * (size_t)states);
        for (int64_t l = 0; l < m; l++)
            add_row(states, FP[i * m + l], T + l * states, row);
        for (int64_t c = states; c < m; c++)
            row[c] = P[c * m + i] = FP[i * m + c];
    }
}

/* Numbers of `work` that a filter needs. */
EXPORT int64_t LEVELLED(work)(int64_t n, int64_t r)
{
    const int64_t m = 2 * n + r;
    return 2 * n * n + 8 * n * m + 2 * m * m + 4 * n + (2 * m + 1) * (m + 2 * n) + 4 * m;
}

/* Extended filter: mean (m) and P (m, m) after sample 0 become those after the last one. */
EXPORT int64_t LEVELLED(extended)(const Filter *f, double *mean, double *P, double *work)
{
    const int64_t n = f->n, m = 2 * n + f->r;
    const Sensitivities step = (Sensitivities)f->step;
    double *F = work, *inverse = F + 2 * n * m, *rest = inverse + n * n;
    for (int64_t k = 0; k + 1 < f->samples; k++) {
        memset(F, 0, 16 * (size_t)(n * m));
        for (int64_t i = 0; i < 2 * n; i++)
            F[i * m + i] = 1.0;
        const int64_t how = step(f->tree, f->model, 1, &k, mean + 2 * n, mean, mean + n, F,
                                 F + n * m, inverse, f->step_memory);
        if (how != DONE)
            return how;
        propagate(2 * n, m, F, P, rest);
        add_noise(f, inverse, P);
        symmetrise(m, P);
        if (!measure(f, k + 1, mean, P, rest))
            return INDEFINITE;
    }
    return DONE;
}

/* U (m, m) of U' U = P, with a small multiple of the diagonal added where rounding has made P
 * indefinite. */
static int root(int64_t m, const double *P, double *U, double *scale)
{
    static const double shares[] = {0.0, 1e-13, 1e-11, 1e-9, 1e-7};
    for (int64_t i = 0; i < m; i++) {
        scale[i] = sqrt(P[i * m + i]);
        scale[i] = scale[i] > 0.0 ? scale[i] : 1.0;
    }
    for (size_t s = 0; s < sizeof shares / sizeof *shares; s++) {
        for (int64_t i = 0; i < m; i++) {
            for (int64_t c = 0; c < m; c++)
                U[i * m + c] = P[i * m + c] / (scale[i] * scale[c]);
            U[i * m + i] += shares[s];
        }
        if (!factorise(m, U))
            continue;
        for (int64_t i = 0; i < m; i++)
            for (int64_t c = i; c < m; c++)
                U[i * m + c] *= scale[c];
        return 1;
    }
    return 0;
}

/* Scaled unscented transform of the model from sample k on, `spread` L + lambda and the centre with
 * `further` weight in the covariance. Sigma points stand at the mean, and at
 * plus and minus each row of the root; the weights of the others are equal, and beta stays. */
static int64_t transform(const Filter *f, double spread, double further, int64_t k, double *mean,
                         double *P, double *inverse, double *work)
{
    const int64_t n = f->n, m = 2 * n + f->r, states = 2 * n, all = 2 * m + 1;
    double *U = work, *scale = U + m * m, *points = scale + m, *moved = points + all * m;
    double *shift = moved + all * states;
    if (!root(m, P, U, scale))
        return INDEFINITE;
    const double size = sqrt(spread), weight = 0.5 / spread;
    for (int64_t i = 0; i < all; i++)
        memcpy(points + i * m, mean, 8 * (size_t)m);
    for (int64_t i = 0; i < m; i++) {
        add_row(m - i, size, U + i * m + i, points + (1 + i) * m + i);
        add_row(m - i, -size, U + i * m + i, points + (1 + m + i) * m + i);
    }
    const int64_t how = ((Predict)f->step)(f->tree, f->model, all, k, points, moved, inverse,
                                           f->step_memory);
    if (how != DONE)
        return how;
    memset(shift, 0, 8 * (size_t)states);
    memset(P, 0, 8 * (size_t)(states * m));
    for (int64_t i = 1; i < all; i++) {
        double *away = moved + i * states;
        add_row(states, -1.0, moved, away);
        add_row(states, weight, away, shift);
        for (int64_t l = 0; l < states; l++)
            add_row(states, weight * away[l], away, P + l * m);
    }
    for (int64_t i = 0; i < m; i++) { /* with beta, whose points stand symmetric about the mean */
        const double *up = moved + (1 + i) * states, *down = moved + (1 + m + i) * states;
        const int64_t first = i < states ? states : i;
        for (int64_t l = 0; l < states; l++)
            add_row(m - first, weight * size * (up[l] - down[l]), U + i * m + first,
                    P + l * m + first);
    }
    for (int64_t l = 0; l < states; l++) {
        add_row(states, further * shift[l], shift, P + l * m);
        for (int64_t c = states; c < m; c++)
            P[c * m + l] = P[l * m + c];
    }
    for (int64_t l = 0; l < states; l++)
        mean[l] = moved[l] + shift[l];
    return DONE;
}

/* Unscented filter, as the extended one. */
EXPORT int64_t LEVELLED(unscented)(const Filter *f, double spread, double further, double *mean,
                                   double *P, double *work)
{
    const int64_t n = f->n, m = 2 * n + f->r;
    double *inverse = work, *rest = inverse + n * n;
    for (int64_t k = 0; k + 1 < f->samples; k++) {
        const int64_t how = transform(f, spread, further, k, mean, P, inverse, rest);
        if (how != DONE)
            return how;
        add_noise(f, inverse, P);
        symmetrise(m, P);
        if (!measure(f, k + 1, mean, P, rest))
            return INDEFINITE;
    }
    return DONE;
}

#ifdef SOURCE_HASH
EXPORT const char *filters_source(void) { return TEXT(SOURCE_HASH); }
#endif
