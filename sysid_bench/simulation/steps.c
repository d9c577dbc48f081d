/* A simulation step by step in which force laws see each state, without Python in between.
 *
 * The engine's step is a function that is handed over. Of its model and data only the places of
 * the few arrays are known that the loop reads and writes.
 */

#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

/* Force laws, as simulation/compiled_steps.py counts them. */
enum { STRIBECK, COUPLED, LUGRE, FRICTION, PERIODIC, GRAVITY_SPRING, CABLES };
enum { FEEDBACK, INTERPOLATED, HELD }; /* inputs, likewise */

typedef void (*Step)(const void *model, void *data);

/* Arrays of the engine's data. */
typedef struct {
    int64_t nq, nv, nu;
    const double *qpos, *qvel, *qacc, *actuator, *passive, *constraint;
    double *ctrl, *applied;
} State;

/* What is recorded of each sample before its step: q (N, nq), v, a, tau (N, nv), and position,
 * velocity and acceleration of the motors (N, nu), referred to their joints. */
typedef struct {
    double *q, *v, *a, *tau, *motor_q, *motor_v, *motor_a;
} Record;

/* Motors (nu): their joints' degrees of freedom, gains, torque limits, kind of input, and, behind an
 * elastic transmission (`elastic`), stiffness, damping, half gap and rotor inertia. */
typedef struct {
    int64_t nu, input, elastic;
    const int64_t *dof;
    const double *kp, *kd, *limit;
    const double *low, *high; /* torques of a motor within the limits of its joint, too */
    const double *stiffness, *damping, *gap, *inertia;
    const double *implicit; /* damping (nv) of an implicit integrator, NULL of an explicit one */
} Drive;

/* Force laws: kinds, numbers and states of each, and the armature (nv) of the links' joints. */
typedef struct {
    int64_t count;
    const int64_t *kinds;
    const double *const *numbers;
    double *const *states;
    const double *armature;
} Laws;

/* What a force law sees of a state: time, positions, velocities, torque on the links (nv each). */
typedef struct {
    double t;
    const double *q, *v, *load;
} Seen;

static void stribeck(const double *x, int64_t nv, const Seen *s, double *tau)
{
    const double *vs = x + nv, *v0 = x + 2 * nv; /* after the sizes (nv) */
    for (int64_t i = 0; i < nv; i++)
        if (x[i] != 0) {
            double slow = s->v[i] / vs[i];
            tau[i] -= x[i] * exp(-slow * slow) * tanh(s->v[i] / v0[i]);
        }
}

static void coupled(const double *x, int64_t nv, const Seen *s, double *tau)
{
    for (int64_t i = 0; i < nv; i++)
        for (int64_t j = 0; j < nv; j++)
            tau[i] -= x[nv * i + j] * s->v[j];
}

/* Numbers: Coulomb and static friction, stiffness, damping, Stribeck velocity (nv each); states:
 * deflections of the bristles z (nv). */
static void lugre(const double *x, double *z, double h, int64_t nv, const Seen *s, double *tau)
{
    const double *fc = x, *fs = x + nv, *s0 = x + 2 * nv, *s1 = x + 3 * nv;
    const double *vs = x + 4 * nv;
    for (int64_t i = 0; i < nv; i++)
        if (fc[i] > 0) {
            double v = s->v[i], slow = v / vs[i], g = fc[i] + (fs[i] - fc[i]) * exp(-slow * slow);
            double end = (v < 0 ? -g : g) / s0[i], old = z[i];
            if (v != 0) /* exact while v is constant */
                z[i] = end + (old - end) * exp(-s0[i] * fabs(v) * h / g);
            tau[i] -= s0[i] * z[i] + s1[i] * (z[i] - old) / h;
        }
}

/* Direction of friction at q behind a transition of width w: the play `p` moves with it. */
static double direction(double *p, double q, double w)
{
    *p = *p < q - w ? q - w : *p > q + w ? q + w : *p;
    return (q - *p) / w;
}

/* Numbers: width and seven coefficients, as FrictionTerms (nv each), rate of decay, elapsed time;
 * states: play (nv). */
static void friction(const double *x, double *p, int64_t nv, const Seen *s, double *tau)
{
    const double rate = x[8 * nv], aged = rate != 0 ? exp(-(s->t + x[8 * nv + 1]) * rate) : 1.0;
    for (int64_t i = 0; i < nv; i++) {
        const double *c = x + i; /* coefficient k of the joint is c[k * nv] */
        double v = s->v[i], speed = fabs(v), load = fabs(s->load[i]);
        double to = direction(p + i, s->q[i], c[0]);
        double force = (c[nv] + c[3 * nv] * load) * to + c[2 * nv] * fabs(to);
        force += (c[4 * nv] + c[6 * nv] * load + c[7 * nv] * speed) * v + c[5 * nv] * speed;
        tau[i] -= aged * force;
    }
}

/* Numbers: orders (3), amplitudes (3 nv), ratio, phase, force, periodic and constant friction, width
 * of their transition, 1 for ripple of the load (nv each); states: play (nv). */
static void periodic(const double *x, double *p, int64_t nv, const Seen *s, double *tau)
{
    for (int64_t i = 0; i < nv; i++) {
        const double *c = x + 3 + i;
        double angle = c[3 * nv] * s->q[i] + c[4 * nv];
        double wave = 0;
        for (int64_t k = 0; k < 3; k++)
            if (c[k * nv] != 0)
                wave += c[k * nv] * sin(x[k] * angle);
        double to = direction(p + i, s->q[i], c[8 * nv]);
        tau[i] -= wave * c[5 * nv] + (wave * c[6 * nv] + c[7 * nv]) * to -
                  c[9 * nv] * wave / (1.0 + wave) * s->load[i];
    }
}

/* Numbers: force, angle, arm, relaxed length (nv each). */
static void gravity_spring(const double *x, int64_t nv, const Seen *s, double *tau)
{
    for (int64_t i = 0; i < nv; i++)
        if (x[i] != 0) {
            double angle = s->q[i] - x[nv + i], arm = x[2 * nv + i];
            double length = sqrt(1 + arm * arm - 2 * arm * cos(angle));
            tau[i] -= x[i] * sin(angle) * (1 - x[3 * nv + i] / length);
        }
}

/* Numbers: stiffness, centre, hysteresis, its width (nv each); states: play (nv). */
static void cables(const double *x, double *p, int64_t nv, const Seen *s, double *tau)
{
    for (int64_t i = 0; i < nv; i++) {
        double q = s->q[i];
        tau[i] -= x[i] * (q - x[nv + i]) + x[2 * nv + i] * direction(p + i, q, x[3 * nv + i]);
    }
}

/* Torque `tau` (nv) minus that of every law over a step `h`, in which their states advance. */
static void take(const Laws *laws, double h, int64_t nv, const Seen *s, double *tau)
{
    for (int64_t l = 0; l < laws->count; l++) {
        const double *x = laws->numbers[l];
        double *states = laws->states[l];
        switch (laws->kinds[l]) {
        case STRIBECK: stribeck(x, nv, s, tau); break;
        case COUPLED: coupled(x, nv, s, tau); break;
        case LUGRE: lugre(x, states, h, nv, s, tau); break;
        case FRICTION: friction(x, states, nv, s, tau); break;
        case PERIODIC: periodic(x, states, nv, s, tau); break;
        case GRAVITY_SPRING: gravity_spring(x, nv, s, tau); break;
        case CABLES: cables(x, states, nv, s, tau); break;
        }
    }
}

static double clipped(double x, double limit)
{
    return x > limit ? limit : x < -limit ? -limit : x;
}

/* Elastic motors `m` (positions, then velocities) and the links at one step: the torque that each
 * transmission gives a link, and the torque of each motor. */
typedef struct {
    double *m, *load, *torque;
} Rotors;

static double wound(const Drive *d, int64_t j, double theta, double q)
{
    double x = theta - q;
    return x - clipped(x, d->gap[j]);
}

/* Rotor with inertia, symplectic in the spring; the damping of a feedback on u is implicit, since a
 * light rotor would otherwise oscillate. A held torque is u itself. */
static void turn_rotor(const Drive *d, int64_t j, double u, double h, double q, double v, Rotors *r)
{
    double *theta = r->m + j, *rate = r->m + d->nu + j, w = *rate, B = d->inertia[j];
    double load = d->stiffness[j] * wound(d, j, *theta, q) + d->damping[j] * (w - v), torque = u;
    if (d->input != HELD) {
        double kp = d->kp[j], kd = d->kd[j], e = u - *theta;
        double next = (B * w + h * (kp * e - load)) / (B + h * kd + h * h * kp);
        torque = clipped(kp * (e - h * next) - kd * next, d->limit[j]);
    }
    w += h / B * (torque - load);
    *rate = w;
    *theta += h * w;
    r->load[j] = load;
    r->torque[j] = torque;
}

/* Motor without inertia: kd w + kp (theta - u) + K dz(theta - q) + D (w - v) = 0 at the end of the
 * step, or the torque limit in place of the feedback. */
static void turn_massless(const Drive *d, int64_t j, double u, double h, double q, double v,
                          Rotors *r)
{
    double *theta = r->m + j, *rate = r->m + d->nu + j, x = wound(d, j, *theta, q);
    double K = d->gap[j] > 0 && x == 0 ? 0.0 : d->stiffness[j], D = d->damping[j];
    double kp = d->kp[j], kd = d->kd[j], e = u - *theta, rest = D * v - K * x;
    double w = (kp * e + rest) / (kd + D + h * (kp + K)), free = kp * (e - h * w) - kd * w;
    double torque = clipped(free, d->limit[j]);
    if (torque != free && D + h * K > 0)
        w = (torque + rest) / (D + h * K);
    *rate = w;
    *theta += h * w;
    r->load[j] = K * (x + h * w) + D * (w - v);
    r->torque[j] = torque;
}

/* Torques of motors that hold them over a control period, from the state at its start. */
static void hold(const Drive *d, const double *u, const State *s, const double *m, double *held)
{
    for (int64_t j = 0; j < d->nu; j++) {
        int64_t i = d->dof[j];
        double q = d->elastic ? m[j] : s->qpos[i], v = d->elastic ? m[d->nu + j] : s->qvel[i];
        held[j] = clipped(d->kp[j] * (u[j] - q) - d->kd[j] * v, d->limit[j]);
    }
}

/* Forces of elastic transmissions on the links, and the rotors' advance by a step. */
static void drive_links(const Drive *d, const double *u, double h, const State *s, Rotors *r)
{
    for (int64_t j = 0; j < d->nu; j++) {
        int64_t i = d->dof[j];
        if (d->inertia[j] > 0)
            turn_rotor(d, j, u[j], h, s->qpos[i], s->qvel[i], r);
        else
            turn_massless(d, j, u[j], h, s->qpos[i], s->qvel[i], r);
        s->applied[i] += r->load[j];
        s->ctrl[j] = 0;
    }
}

/* Acceleration and torque (nv) of an implicit step, from those of its start: rates of dampers and
 * feedbacks are those at its end, but for motors at their limit. */
static void use_end_of_step(const Drive *d, double h, const State *s, const double *v, double *a,
                            double *tau)
{
    for (int64_t j = 0; j < d->nu; j++) {
        int64_t i = d->dof[j];
        if (d->input != HELD && tau[i] > d->low[j] && tau[i] < d->high[j])
            tau[i] -= d->kd[j] * (s->qvel[i] - v[i]);
    }
    for (int64_t i = 0; i < s->nv; i++) {
        a[i] = (s->qvel[i] - v[i]) / h;
        tau[i] -= d->implicit[i] * (s->qvel[i] - v[i]);
    }
}

/* `samples` of the record from the time t on, `each` steps of `h` per sample; inputs u
 * (samples, nu), constant forces (nv); `m` (2 nu) are positions and velocities of elastic motors,
 * `work` has room for nv + 4 nu. */
EXPORT void simulation_steps(Step step, const void *model, void *data, const State *s, double t,
                             int64_t samples, int64_t each, double h, const double *u,
                             const double *constant, const Laws *laws, const Drive *drive,
                             double *m, double *work, const Record *out)
{
    const int64_t nq = s->nq, nv = s->nv, nu = s->nu;
    double *load = work, *held = load + nv, *now = held + nu;
    Rotors rotors = {m, now + nu, now + 2 * nu};
    memset(load, 0, 8 * nv);
    for (int64_t k = 0; k < samples; k++) {
        const double *u0 = u + k * nu, *u1 = k + 1 < samples ? u0 + nu : u0;
        memcpy(out->q + k * nq, s->qpos, 8 * nq);
        memcpy(out->v + k * nv, s->qvel, 8 * nv);
        if (drive->elastic) {
            memcpy(out->motor_q + k * nu, m, 8 * nu);
            memcpy(out->motor_v + k * nu, m + nu, 8 * nu);
        }
        if (drive->input == HELD)
            hold(drive, u0, s, m, held);
        for (int64_t i = 0; i < each; i++) {
            double part = drive->input == INTERPOLATED ? (double)i / (double)each : 0.0;
            Seen seen = {t + (double)(k * each + i) * h, s->qpos, s->qvel, load};
            for (int64_t j = 0; j < nu; j++)
                now[j] = drive->input == HELD ? held[j] : u0[j] + part * (u1[j] - u0[j]);
            memcpy(s->applied, constant, 8 * nv);
            take(laws, h, nv, &seen, s->applied);
            if (drive->elastic)
                drive_links(drive, now, h, s, &rotors);
            else
                memcpy(s->ctrl, now, 8 * nu);
            step(model, data);
            for (int64_t j = 0; j < nv; j++)
                load[j] = s->actuator[j] + s->applied[j] + s->passive[j] + s->constraint[j] -
                          laws->armature[j] * s->qacc[j];
            if (i > 0)
                continue;
            memcpy(out->a + k * nv, s->qacc, 8 * nv);
            memcpy(out->tau + k * nv, s->actuator, 8 * nv);
            if (drive->implicit)
                use_end_of_step(drive, h, s, out->v + k * nv, out->a + k * nv, out->tau + k * nv);
            for (int64_t j = 0; j < nu && drive->elastic; j++) {
                out->tau[k * nv + drive->dof[j]] = rotors.torque[j];
                out->motor_a[k * nu + j] = (m[nu + j] - out->motor_v[k * nu + j]) / h;
            }
        }
    }
}

/* Torque (samples, nv) that laws take along a given motion from the time t on: q, v, load
 * (samples, nv) are interpolated linearly at `each` steps of `h` per sample; `work` (4 nv). */
EXPORT void laws_along(const Laws *laws, double t, int64_t samples, int64_t each, double h,
                       int64_t nv, const double *q, const double *v, const double *load,
                       double *work, double *tau)
{
    const double *from[3] = {q, v, load};
    const Seen seen = {0.0, work, work + nv, work + 2 * nv};
    for (int64_t k = 0; k < samples; k++)
        for (int64_t i = 0; i < each; i++) {
            const double part = (double)i / (double)each;
            const int64_t here = k * nv, next = k + 1 < samples ? nv : 0;
            for (int64_t x = 0; x < 3 * nv; x++) {
                const double *p = from[x / nv] + here + x % nv;
                work[x] = p[0] + part * (p[next] - p[0]);
            }
            Seen at = seen;
            at.t = t + (double)(k * each + i) * h;
            double *taken = work + 3 * nv;
            memset(taken, 0, 8 * nv);
            take(laws, h, nv, &at, taken);
            for (int64_t j = 0; j < nv && i == 0; j++)
                tau[here + j] = -taken[j];
        }
}

#ifdef SOURCE_HASH
#define TEXT_(x) #x
#define TEXT(x) TEXT_(x)
EXPORT const char *steps_source(void) { return TEXT(SOURCE_HASH); }
#endif
