/* A simulation step by step in which force laws look at each state, without Python in between.
 *
 * The engine's step is a function that is handed over; of its model and data nothing is known here
 * but the places of the few arrays that the loop reads and writes.
 */

#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

enum { STRIBECK, COUPLED }; /* as simulation/compiled_steps.py counts them */

typedef void (*Step)(const void *model, void *data);

/* Arrays of the engine's data. */
typedef struct {
    int64_t nq, nv, nu;
    const double *qpos, *qvel, *qacc, *actuator;
    double *ctrl, *applied;
} State;

/* What is recorded of each sample before its step: q (N, nq), v, a, tau (N, nv). */
typedef struct {
    double *q, *v, *a, *tau;
} Record;

/* Torque that a law takes away; `x` are its numbers. */
static void take(int64_t kind, const double *x, int64_t nv, const double *v, double *tau)
{
    if (kind == STRIBECK) { /* share (nv), vs, v0 */
        const double vs = x[nv], v0 = x[nv + 1];
        for (int64_t i = 0; i < nv; i++)
            if (x[i] != 0) {
                double slow = v[i] / vs;
                tau[i] -= x[i] * exp(-slow * slow) * tanh(v[i] / v0);
            }
    } else { /* a matrix (nv, nv) */
        for (int64_t i = 0; i < nv; i++)
            for (int64_t j = 0; j < nv; j++)
                tau[i] -= x[nv * i + j] * v[j];
    }
}

/* `samples` of the record, `each` steps per sample; inputs u (samples, nu), constant forces (nv). */
EXPORT void simulation_steps(Step step, const void *model, void *data, const State *s,
                             int64_t samples, int64_t each, const double *u, const double *constant,
                             int64_t laws, const int64_t *kinds, const double *const *numbers,
                             const Record *out)
{
    const int64_t nq = s->nq, nv = s->nv;
    for (int64_t k = 0; k < samples; k++) {
        memcpy(s->ctrl, u + k * s->nu, 8 * s->nu);
        memcpy(out->q + k * nq, s->qpos, 8 * nq);
        memcpy(out->v + k * nv, s->qvel, 8 * nv);
        for (int64_t i = 0; i < each; i++) {
            memcpy(s->applied, constant, 8 * nv);
            for (int64_t l = 0; l < laws; l++)
                take(kinds[l], numbers[l], nv, s->qvel, s->applied);
            step(model, data);
            if (i == 0) {
                memcpy(out->a + k * nv, s->qacc, 8 * nv);
                memcpy(out->tau + k * nv, s->actuator, 8 * nv);
            }
        }
    }
}

#ifdef SOURCE_HASH
#define TEXT_(x) #x
#define TEXT(x) TEXT_(x)
EXPORT const char *steps_source(void) { return TEXT(SOURCE_HASH); }
#endif
