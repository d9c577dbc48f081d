/* Forward dynamics of many plants of one tree at once, a plant in each lane of a vector register.
 *
 * Plants share the tree, the motors' places, the integrator and the step; inertias, joint terms,
 * gains, numbers of force laws, starts and inputs are their own. No lane reads another one, so that a
 * plant that diverges changes no other. One register per number: with two the compiler runs out of
 * registers, which costs five times as much (measured).
 *
 * A step is MuJoCo's: composite rigid bodies and L' D L along the tree (Featherstone 2008, chapters 6
 * and 8), Coulomb friction that sticks as a convex problem, semi-implicit Euler or `implicitfast`.
 * Written from the equations: no code is shared with MuJoCo or with the regressor kernel.
 *
 * Every joint is a frame with its axis as z and its anchor as origin, so that constants turn a
 * parent's vectors to the axes of the joint, and only z components act on it. Vectors are in these
 * axes; d is the classical acceleration of the origin less gravity, in which linear velocity drops
 * out. A body with several joints has several frames, of which the last one carries its inertia.
 */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#ifndef LEVEL
#define LEVEL base
#endif
#define JOIN_(a, b) a##_##b
#define JOIN(a, b) JOIN_(a, b)
#define LEVELLED(name) JOIN(name, LEVEL)
#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif

typedef double V __attribute__((vector_size(8 * LANES)));
typedef int64_t I __attribute__((vector_size(8 * LANES)));

typedef struct {
    V x, y, z;
} V3;

enum { FREE, BALL, SLIDE, HINGE }; /* MuJoCo's kinds of joints */
enum { STRIBECK, COUPLED, LUGRE, FRICTION, PERIODIC, GRAVITY_SPRING, CABLES }; /* as in steps.c */
enum { FEEDBACK, INTERPOLATED, HELD };                                         /* inputs, likewise */
enum { EXPLICIT, DAMPERS, ALL_DAMPERS }; /* what is taken at the end of a step: nothing, dampers of
                                            joints, or these and the motors' rate feedback */

/* What all plants of a batch share. Joint j is behind joint before[j] (-1: the world), with the pose
 * R0 p0 of its frame there at q = q0. Force laws have `law_numbers` numbers and `law_states` states
 * each. Coulomb friction is MuJoCo's soft constraint: it pulls a rate to zero at `stick_rate` (1/s,
 * nv), with `stick_share` (nv) of the inverse inertia at the reference posture as its softness. */
typedef struct {
    int64_t joints, nq, nv, nu, laws;
    const int64_t *kind, *before, *qadr, *vadr;
    const double *R0, *p0, *q0, *gravity;
    const int64_t *motor, *motor_place; /* degree of freedom, and place in q, of each motor (nu) */
    const double *spring_reference, *stick_rate, *stick_share;
    const int64_t *law_kind, *law_numbers, *law_states;
    int64_t input, elastic;
    int64_t at_end, needs_start; /* needs_start: the acceleration at the start of a step is used, too */
    int64_t records_end;         /* accelerations and torques of samples are those at the step's end */
} Tree;

/* Signals of each plant (plants, samples, nq or nv or nu), as simulation_steps in steps.c. */
typedef struct {
    double *q, *v, *a, *tau, *motor_q, *motor_v, *motor_a;
} Record;

typedef struct {
    V R[9]; /* to the axes of the frame before */
    V3 p;   /* origin, in the frame before */
    V3 w, alpha, d, force, moment;
    V m, J[6]; /* of the composite body, J about the origin: xx xy xz yy yz zz */
    V3 h;
} Frame;

/* Numbers of the plants of a group, and the state and results of their steps. */
typedef struct {
    const V *inertia;                                            /* (joints, 10) */
    const V *armature, *viscous, *coulomb, *spring, *offset;     /* (nv) */
    const V *kp, *kd, *limit, *low, *high; /* (nu); low, high: of the joint, too */
    const V *stiffness, *damping, *gap, *rotor;                  /* (nu), of elastic joints */
    const V *law;                                                /* numbers of all laws, in order */
    V *states;                                                   /* of all laws, in order */
    V *q, *v, *a, *bias, *force, *motors, *applied, *load, *end; /* (nq), then (nv) */
    V *M, *L, *solved, *side, *inverse_inertia, *product, *move; /* packed; (nv) */
    V *dampers;                                                  /* h (nv) of dampers at the end */
    V *block;                                                    /* signals of BLOCK samples */
    V *now, *held, *theta, *rate, *before, *given;               /* (nu) */
    I *sticks;                                                   /* (nv) */
    int64_t *dof_before, *row;                                   /* (nv), (nv + 1) */
    Frame *frames;
    int64_t has_coulomb;
} Group;

/* --- Numbers in lanes -------------------------------------------------------------------------- */

static inline V all(double x) { return x - (V){0}; }

static inline V pick(I where, V a, V b) { return (V)((where & (I)a) | (~where & (I)b)); }

static inline V size_of(V x) { return (V)((I)x & INT64_MAX); }

static inline V least(V a, V b) { return pick(a < b, a, b); }

static inline V clipped(V x, V low, V high) { return pick(x > high, high, pick(x < low, low, x)); }

static inline int any(I where)
{
    int64_t found = 0;
    for (int l = 0; l < LANES; l++)
        found |= where[l];
    return found != 0;
}

static inline V root(V x)
{
    for (int l = 0; l < LANES; l++)
        x[l] = sqrt(x[l]);
    return x;
}

/* Reduction by pi/2 in three parts and the polynomials of fdlibm, below one unit in the last place up
 * to a million radians; what turns further has diverged. */
static inline void sine_cosine(V x, V *s, V *c)
{
    const double part1 = 1.57079632673412561417e+00, part2 = 6.07710050630396597660e-11,
                 part3 = 2.02226624879595063154e-21, to_integer = 0x1.8p52;
    V n = x * 0.63661977236758134308 + to_integer;
    I quarter = (I)n;
    n -= to_integer;
    V r = ((x - n * part1) - n * part2) - n * part3, z = r * r;
    V sine = r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03
        + z * (-1.98412698298579493134e-04 + z * (2.75573137070700676789e-06
        + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))));
    V cosine = 1.0 - 0.5 * z + z * z * (4.16666666666666019037e-02
        + z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05
        + z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09
        + z * -1.13596475577881948265e-11)))));
    I swap = -(quarter & 1), a = (I)sine, b = (I)cosine;
    *s = (V)(((a & ~swap) | (b & swap)) ^ ((quarter & 2) << 62));
    *c = (V)(((b & ~swap) | (a & swap)) ^ (((quarter + 1) & 2) << 62));
}

/* Reduction by ln 2 in two parts and Taylor's series to the 13th power, two units in the last place;
 * even and odd powers are summed apart, since one chain of sums would wait for each of its own. */
static inline V exponential(V x)
{
    const double to_integer = 0x1.8p52;
    x = clipped(x, all(-700.0), all(700.0));
    V n = x * 1.44269504088896338700 + to_integer;
    I power = (I)n << 52;
    n -= to_integer;
    V r = (x - n * 6.93147180369123816490e-01) - n * 1.90821492927058770002e-10, z = r * r;
    V even = 1.0 + z * (1.0 / 2 + z * (1.0 / 24 + z * (1.0 / 720 + z * (1.0 / 40320
           + z * (1.0 / 3628800 + z * (1.0 / 479001600))))));
    V odd = 1.0 + z * (1.0 / 6 + z * (1.0 / 120 + z * (1.0 / 5040 + z * (1.0 / 362880
          + z * (1.0 / 39916800 + z * (1.0 / 6227020800.0))))));
    return (V)((I)(even + r * odd) + power);
}

/* Its error is relative to 1, not to a small value: friction near zero rate is as exact as friction. */
static inline V hyperbolic_tangent(V x)
{
    V y = 1.0 - 2.0 / (exponential(2.0 * least(size_of(x), all(20.0))) + 1.0);
    return (V)((I)y | ((I)x & INT64_MIN));
}

static inline V3 all3(const double *x) { return (V3){all(x[0]), all(x[1]), all(x[2])}; }

static inline V3 add(V3 a, V3 b) { return (V3){a.x + b.x, a.y + b.y, a.z + b.z}; }

static inline V3 scaled(V3 a, V by) { return (V3){a.x * by, a.y * by, a.z * by}; }

static inline V3 cross(V3 a, V3 b)
{
    return (V3){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

/* A rotation of 9 numbers, row by row: R x and R' x. */
static inline V3 turn(const V *R, V3 x)
{
    return (V3){R[0] * x.x + R[1] * x.y + R[2] * x.z, R[3] * x.x + R[4] * x.y + R[5] * x.z,
                R[6] * x.x + R[7] * x.y + R[8] * x.z};
}

static inline V3 turn_back(const V *R, V3 x)
{
    return (V3){R[0] * x.x + R[3] * x.y + R[6] * x.z, R[1] * x.x + R[4] * x.y + R[7] * x.z,
                R[2] * x.x + R[5] * x.y + R[8] * x.z};
}

/* Symmetric matrix xx xy xz yy yz zz times a vector. */
static inline V3 times(const V *J, V3 x)
{
    return (V3){J[0] * x.x + J[1] * x.y + J[2] * x.z, J[1] * x.x + J[3] * x.y + J[4] * x.z,
                J[2] * x.x + J[4] * x.y + J[5] * x.z};
}

/* Acceleration of the point r of a body against that of its origin. */
static inline V3 swing(V3 w, V3 alpha, V3 r)
{
    return add(cross(alpha, r), cross(w, cross(w, r)));
}

/* --- Kinematics, bias and mass matrix ---------------------------------------------------------- */

static int dofs_of(int64_t kind) { return kind == FREE ? 6 : kind == BALL ? 3 : 1; }

static inline void quaternion_matrix(V *R, const V *q)
{
    V w = q[0], x = q[1], y = q[2], z = q[3], two = 2.0 / (w * w + x * x + y * y + z * z);
    R[0] = 1.0 - two * (y * y + z * z);
    R[1] = two * (x * y - w * z);
    R[2] = two * (x * z + w * y);
    R[3] = two * (x * y + w * z);
    R[4] = 1.0 - two * (x * x + z * z);
    R[5] = two * (y * z - w * x);
    R[6] = two * (x * z - w * y);
    R[7] = two * (y * z + w * x);
    R[8] = 1.0 - two * (x * x + y * y);
}

static inline void place(const Tree *t, int64_t j, const V *q, Frame *f)
{
    const double *R0 = t->R0 + 9 * j;
    V s, c, Q[9];
    f->p = all3(t->p0 + 3 * j);
    switch (t->kind[j]) {
    case HINGE:
        sine_cosine(q[0] - t->q0[j], &s, &c);
        for (int i = 0; i < 9; i += 3) {
            f->R[i] = R0[i] * c + R0[i + 1] * s;
            f->R[i + 1] = R0[i + 1] * c - R0[i] * s;
            f->R[i + 2] = all(R0[i + 2]);
        }
        break;
    case SLIDE:
        s = q[0] - t->q0[j];
        f->p = add(f->p, (V3){R0[2] * s, R0[5] * s, R0[8] * s});
        for (int i = 0; i < 9; i++)
            f->R[i] = all(R0[i]);
        break;
    case BALL:
        quaternion_matrix(Q, q);
        for (int i = 0; i < 9; i += 3)
            for (int k = 0; k < 3; k++)
                f->R[i + k] = R0[i] * Q[k] + R0[i + 1] * Q[3 + k] + R0[i + 2] * Q[6 + k];
        break;
    case FREE: quaternion_matrix(f->R, q + 3); break; /* of its position nothing depends */
    }
}

/* Rates of a joint's frame at zero joint accelerations, and what its inertia then needs. */
static inline void move(const Tree *t, int64_t j, const V *v, const Frame *before, Frame *f)
{
    const V none = all(0.0);
    V3 w = {none, none, none}, alpha = w, d = scaled(all3(t->gravity), all(-1.0));
    if (before) {
        d = add(before->d, swing(before->w, before->alpha, f->p));
        w = turn_back(f->R, before->w);
        alpha = turn_back(f->R, before->alpha);
    }
    d = turn_back(f->R, d);
    switch (t->kind[j]) {
    case HINGE:
        alpha.x += w.y * v[0];
        alpha.y -= w.x * v[0];
        w.z += v[0];
        break;
    case SLIDE: /* Coriolis */
        d.x += 2.0 * w.y * v[0];
        d.y -= 2.0 * w.x * v[0];
        break;
    default: { /* linear rates of a free joint are in the world: no acceleration comes from them */
        const V *own = t->kind[j] == FREE ? v + 3 : v;
        V3 rate = {own[0], own[1], own[2]};
        alpha = add(alpha, cross(w, rate));
        w = add(w, rate);
    }
    }
    f->w = w;
    f->alpha = alpha;
    f->d = d;
    f->force = add(scaled(d, f->m), swing(w, alpha, f->h));
    f->moment = add(add(times(f->J, alpha), cross(w, times(f->J, w))), cross(f->h, d));
}

/* Components of a force and moment along the degrees of freedom of joint j. */
static inline void components(const Tree *t, int64_t j, const Frame *f, V3 force, V3 moment, V *out)
{
    switch (t->kind[j]) {
    case HINGE: out[0] = moment.z; return;
    case SLIDE: out[0] = force.z; return;
    case BALL: out[0] = moment.x, out[1] = moment.y, out[2] = moment.z; return;
    default:
        force = turn(f->R, force);
        out[0] = force.x, out[1] = force.y, out[2] = force.z;
        out[3] = moment.x, out[4] = moment.y, out[5] = moment.z;
    }
}

/* Force and moment of a composite body under a unit acceleration of degree of freedom k of its
 * joint. */
static inline void unit_wrench(int64_t kind, int k, const Frame *f, V3 *force, V3 *moment)
{
    const V zero = all(0.0);
    const V3 h = f->h;
    if (kind == SLIDE || (kind == FREE && k < 3)) {
        V3 u = {zero, zero, all(1.0)};
        if (kind == FREE)
            u = (V3){f->R[3 * k], f->R[3 * k + 1], f->R[3 * k + 2]};
        *force = scaled(u, f->m);
        *moment = cross(h, u);
        return;
    }
    switch (kind == HINGE ? 2 : kind == FREE ? k - 3 : k) {
    case 0:
        *force = (V3){zero, -h.z, h.y};
        *moment = (V3){f->J[0], f->J[1], f->J[2]};
        break;
    case 1:
        *force = (V3){h.z, zero, -h.x};
        *moment = (V3){f->J[1], f->J[3], f->J[4]};
        break;
    default:
        *force = (V3){-h.y, h.x, zero};
        *moment = (V3){f->J[2], f->J[4], f->J[5]};
    }
}

/* Add the composite body of a frame, turned and moved, to that of the frame before. */
static inline void join_bodies(const Frame *f, Frame *to)
{
    V3 p = f->p, h = turn(f->R, f->h);
    V3 a = turn(f->R, (V3){f->J[0], f->J[1], f->J[2]});
    V3 b = turn(f->R, (V3){f->J[1], f->J[3], f->J[4]});
    V3 c = turn(f->R, (V3){f->J[2], f->J[4], f->J[5]});
    V3 x = turn(f->R, (V3){a.x, b.x, c.x}), y = turn(f->R, (V3){a.y, b.y, c.y});
    V3 z = turn(f->R, (V3){a.z, b.z, c.z});
    V3 mp = scaled(p, f->m), g = add(add(h, h), mp);
    V px = p.x * g.x, py = p.y * g.y, pz = p.z * g.z;
    to->J[0] += x.x + py + pz;
    to->J[3] += y.y + px + pz;
    to->J[5] += z.z + px + py;
    to->J[1] += x.y - (p.x * h.y + h.x * p.y + mp.x * p.y);
    to->J[2] += x.z - (p.x * h.z + h.x * p.z + mp.x * p.z);
    to->J[4] += y.z - (p.y * h.z + h.y * p.z + mp.y * p.z);
    to->h = add(to->h, add(h, mp));
    to->m += f->m;
}

/* Row of M for each degree of freedom: itself, then those before it on the way to the world. */
static inline void mass_rows(const Tree *t, Group *g, int64_t j)
{
    const Frame *f = g->frames + j;
    V own[6];
    V3 force, moment;
    for (int k = 0; k < dofs_of(t->kind[j]); k++) {
        const int64_t dof = t->vadr[j] + k;
        V *row = g->M + g->row[dof];
        unit_wrench(t->kind[j], k, f, &force, &moment);
        components(t, j, f, force, moment, own);
        for (int i = k; i >= 0; i--)
            *row++ = own[i];
        g->M[g->row[dof]] += g->armature[dof];
        for (int64_t at = j; t->before[at] >= 0;) {
            const Frame *here = g->frames + at;
            force = turn(here->R, force);
            moment = add(turn(here->R, moment), cross(here->p, force));
            at = t->before[at];
            components(t, at, g->frames + at, force, moment, own);
            for (int i = dofs_of(t->kind[at]) - 1; i >= 0; i--)
                *row++ = own[i];
        }
    }
}

/* M (packed) and bias (nv) at q and v. */
static void dynamics(const Tree *t, Group *g)
{
    for (int64_t j = 0; j < t->joints; j++) {
        Frame *f = g->frames + j;
        const V *x = g->inertia + 10 * j;
        f->m = x[0];
        f->h = (V3){x[1], x[2], x[3]};
        memcpy(f->J, x + 4, sizeof f->J);
        place(t, j, g->q + t->qadr[j], f);
        move(t, j, g->v + t->vadr[j], t->before[j] < 0 ? NULL : g->frames + t->before[j], f);
    }
    for (int64_t j = t->joints - 1; j >= 0; j--) {
        Frame *f = g->frames + j;
        components(t, j, f, f->force, f->moment, g->bias + t->vadr[j]);
        mass_rows(t, g, j);
        if (t->before[j] < 0)
            continue;
        Frame *to = g->frames + t->before[j];
        V3 force = turn(f->R, f->force);
        to->force = add(to->force, force);
        to->moment = add(to->moment, add(turn(f->R, f->moment), cross(f->p, force)));
        join_bodies(f, to);
    }
}

/* --- L' D L of a packed matrix ----------------------------------------------------------------- */

/* In place: rows of L, and 1 / D where D was. Leaves come first, so that no zero is filled in. */
static void factorise(const Tree *t, const Group *g, V *M)
{
    for (int64_t k = t->nv - 1; k >= 0; k--) {
        V *own = M + g->row[k], inverse = 1.0 / own[0];
        const int64_t length = g->row[k + 1] - g->row[k];
        int64_t i = g->dof_before[k];
        for (int64_t x = 1; x < length; x++, i = g->dof_before[i]) {
            V *row = M + g->row[i], share = own[x] * inverse;
            for (int64_t y = x; y < length; y++)
                row[y - x] -= share * own[y];
            own[x] = share;
        }
        own[0] = inverse;
    }
}

static void solve(const Tree *t, const Group *g, const V *L, V *x)
{
    for (int64_t k = t->nv - 1; k >= 0; k--) {
        const V *own = L + g->row[k] + 1;
        for (int64_t i = g->dof_before[k]; i >= 0; i = g->dof_before[i])
            x[i] -= *own++ * x[k];
    }
    for (int64_t k = 0; k < t->nv; k++) {
        const V *own = L + g->row[k];
        V sum = x[k] * *own++;
        for (int64_t i = g->dof_before[k]; i >= 0; i = g->dof_before[i])
            sum -= *own++ * x[i];
        x[k] = sum;
    }
}

/* y = M x of the packed M. */
static void multiply(const Tree *t, const Group *g, const V *x, V *y)
{
    for (int64_t k = 0; k < t->nv; k++) {
        const V *own = g->M + g->row[k];
        y[k] = *own++ * x[k];
        for (int64_t i = g->dof_before[k]; i >= 0; i = g->dof_before[i], own++) {
            y[k] += *own * x[i];
            y[i] += *own * x[k];
        }
    }
}

/* L D L' of M + diagonal, in g->L. */
static void factorise_with(const Tree *t, Group *g, const V *diagonal)
{
    memcpy(g->L, g->M, sizeof(V) * (size_t)g->row[t->nv]);
    for (int64_t i = 0; diagonal && i < t->nv; i++)
        g->L[g->row[i]] += diagonal[i];
    factorise(t, g, g->L);
}

/* --- Coulomb friction that sticks -------------------------------------------------------------- */

/* MuJoCo's friction loss: the force f(a) = clip(-(a - a_ref) / R, -fc, fc) with a_ref = -rate v, for
 * which M a = force + f(a). The energy of that equation is convex and piecewise quadratic; Newton's
 * method ends at its minimum exactly, since a piece that keeps is solved by one system. */
static inline V softness(const Tree *t, const Group *g, int64_t i)
{
    V R = g->inverse_inertia[i] * t->stick_share[i];
    return pick(R > 1e-15, R, all(1e-15));
}

static inline V friction_force(const Tree *t, const Group *g, int64_t i, V a)
{
    V f = -(a + t->stick_rate[i] * g->v[i]) / softness(t, g, i), fc = g->coulomb[i];
    return clipped(f, -fc, fc);
}

/* Slope of the energy at a + share p along p: zero at its minimum, and rising with the share. */
static V slope(const Tree *t, const Group *g, const V *Ma, const V *Mp, const V *p, V share)
{
    V sum = all(0.0);
    for (int64_t i = 0; i < t->nv; i++)
        sum += p[i] * (Ma[i] + share * Mp[i] - g->force[i]
                       - friction_force(t, g, i, g->a[i] + share * p[i]));
    return sum;
}

/* Where Newton's full step p leads beyond the minimum along it: the share that reaches it, by
 * bisection; 1 in other lanes. */
static V step_share(const Tree *t, Group *g, V *p)
{
    V *Ma = g->product, *Mp = g->side;
    multiply(t, g, g->a, Ma);
    multiply(t, g, p, Mp);
    V low = all(0.0), high = all(1.0);
    /* Above rounding errors: within one piece the full step ends at the minimum itself. */
    I beyond = slope(t, g, Ma, Mp, p, high) > -1e-9 * slope(t, g, Ma, Mp, p, low);
    if (!any(beyond))
        return high;
    for (int k = 0; k < 40; k++) {
        V middle = 0.5 * (low + high);
        I up = slope(t, g, Ma, Mp, p, middle) > 0.0;
        high = pick(up, middle, high);
        low = pick(up, low, middle);
    }
    return pick(beyond, low, all(1.0));
}

#define MOST_PIECES 50 /* far above what was met: 12 */

/* Pieces of friction at a: which joints stick (their `end` is then 1 / R), and the force of the others
 * with that of a_ref in `side`. Returns the lanes that have another piece than before. */
static I pieces(const Tree *t, Group *g, V *side)
{
    I changed = (I){0};
    for (int64_t i = 0; i < t->nv; i++) {
        V inverse = 1.0 / softness(t, g, i), fc = g->coulomb[i];
        V reach = -(g->a[i] + t->stick_rate[i] * g->v[i]) * inverse;
        I now = (reach > fc) & 1;
        now |= (reach < -fc) & 2;
        changed |= now != g->sticks[i];
        g->sticks[i] = now;
        I loose = now != 0;
        g->end[i] = pick(loose | (fc == 0.0), all(0.0), inverse);
        side[i] = g->force[i] + pick(now == 1, fc, pick(now == 2, -fc,
            pick(fc == 0.0, all(0.0), -inverse * t->stick_rate[i] * g->v[i])));
    }
    return changed;
}

/* Acceleration (nv) of M a = force + f(a), from that of the step before on. */
static void solve_friction(const Tree *t, Group *g)
{
    const size_t bytes = sizeof(V) * (size_t)t->nv;
    for (int64_t i = 0; i < t->nv; i++)
        g->sticks[i] = (I){0} - 1; /* no piece: the first one is new */
    I open = (I){0} - 1;
    for (int k = 0; k < MOST_PIECES; k++) {
        open &= pieces(t, g, g->solved);
        if (!any(open))
            return;
        factorise_with(t, g, g->end);
        solve(t, g, g->L, g->solved);
        if (k == 0) { /* any start will do: the energy has to fall from here on */
            memcpy(g->a, g->solved, bytes);
            continue;
        }
        for (int64_t i = 0; i < t->nv; i++)
            g->move[i] = g->solved[i] - g->a[i];
        V share = step_share(t, g, g->move);
        for (int64_t i = 0; i < t->nv; i++) { /* a lane that has ended waits for the others */
            V next = pick(share == 1.0, g->solved[i], g->a[i] + share * g->move[i]);
            g->a[i] = pick(open, next, g->a[i]);
        }
    }
}

/* Diagonal of M^-1 (nv) at the reference posture `q`, mean over ball joints and over translations and
 * rotations of a free one, as MuJoCo weights its constraints. */
static void reference_inertia(const Tree *t, Group *g)
{
    const size_t bytes = sizeof(V) * (size_t)t->nv;
    memset(g->v, 0, bytes);
    dynamics(t, g);
    factorise_with(t, g, NULL);
    for (int64_t i = 0; i < t->nv; i++) {
        memset(g->solved, 0, bytes);
        g->solved[i] = all(1.0);
        solve(t, g, g->L, g->solved);
        g->inverse_inertia[i] = g->solved[i];
    }
    for (int64_t j = 0; j < t->joints; j++)
        for (int k = 0; k + 3 <= dofs_of(t->kind[j]); k += 3) {
            V *x = g->inverse_inertia + t->vadr[j] + k;
            x[0] = x[1] = x[2] = (x[0] + x[1] + x[2]) / 3.0;
        }
}

/* --- Force laws: those of steps.c -------------------------------------------------------------- */

static void stribeck(const Tree *t, const Group *g, const V *x, V *tau)
{
    const int64_t nv = t->nv;
    for (int64_t i = 0; i < nv; i++) {
        I there = x[i] != 0.0;
        if (!any(there))
            continue;
        V vs = x[nv + i], v0 = pick(there, x[2 * nv + i], all(1.0)), v = g->v[i];
        V force = x[i] * hyperbolic_tangent(v / v0);
        if (any(there & (vs < (double)INFINITY)))
            force *= exponential(-(v / vs) * (v / vs));
        tau[i] -= pick(there, force, all(0.0));
    }
}

static void coupled(const Tree *t, const Group *g, const V *x, V *tau)
{
    for (int64_t i = 0; i < t->nv; i++)
        for (int64_t k = 0; k < t->nv; k++)
            tau[i] -= x[t->nv * i + k] * g->v[k];
}

static void lugre(const Tree *t, const Group *g, const V *x, V *z, double h, V *tau)
{
    const int64_t nv = t->nv;
    const V *fc = x, *fs = x + nv, *s0 = x + 2 * nv, *s1 = x + 3 * nv, *vs = x + 4 * nv;
    for (int64_t i = 0; i < nv; i++) {
        I there = fc[i] > 0.0;
        if (!any(there))
            continue;
        V v = g->v[i], slow = v / vs[i], bound = fc[i] + (fs[i] - fc[i]) * exponential(-slow * slow);
        V end = pick(v < 0.0, -bound, bound) / s0[i], old = z[i];
        V next = end + (old - end) * exponential(-s0[i] * size_of(v) * h / bound);
        z[i] = pick(there & (v != 0.0), next, old);
        tau[i] -= pick(there, s0[i] * z[i] + s1[i] * (z[i] - old) / h, all(0.0));
    }
}

/* Direction of friction at q behind a transition of width w: the play `p` moves with it. */
static inline V direction(V *p, V q, V w)
{
    *p = clipped(*p, q - w, q + w);
    return (q - *p) / w;
}

static void friction(const Tree *t, const Group *g, const V *x, V *p, double time, V *tau)
{
    const int64_t nv = t->nv;
    const V rate = x[8 * nv];
    V aged = all(1.0);
    if (any(rate != 0.0))
        aged = exponential(-(time + x[8 * nv + 1]) * rate);
    for (int64_t i = 0; i < nv; i++) {
        const V *c = x + i;
        V v = g->v[i], speed = size_of(v), load = size_of(g->load[i]);
        V to = direction(p + i, g->q[i], c[0]);
        V force = (c[nv] + c[3 * nv] * load) * to + c[2 * nv] * size_of(to);
        force += (c[4 * nv] + c[6 * nv] * load + c[7 * nv] * speed) * v + c[5 * nv] * speed;
        tau[i] -= aged * force;
    }
}

static void periodic(const Tree *t, const Group *g, const V *x, V *p, V *tau)
{
    const int64_t nv = t->nv;
    for (int64_t i = 0; i < nv; i++) {
        const V *c = x + 3 + i;
        V angle = c[3 * nv] * g->q[i] + c[4 * nv], wave = all(0.0), sine, cosine;
        for (int64_t k = 0; k < 3; k++)
            if (any(c[k * nv] != 0.0)) {
                sine_cosine(x[k] * angle, &sine, &cosine);
                wave += c[k * nv] * sine;
            }
        V to = direction(p + i, g->q[i], c[8 * nv]);
        tau[i] -= wave * c[5 * nv] + (wave * c[6 * nv] + c[7 * nv]) * to
                - c[9 * nv] * wave / (1.0 + wave) * g->load[i];
    }
}

static void gravity_spring(const Tree *t, const Group *g, const V *x, V *tau)
{
    const int64_t nv = t->nv;
    for (int64_t i = 0; i < nv; i++) {
        V arm = x[2 * nv + i], sine, cosine;
        I there = x[i] != 0.0;
        if (!any(there))
            continue;
        sine_cosine(g->q[i] - x[nv + i], &sine, &cosine);
        V length = root(1.0 + arm * arm - 2.0 * arm * cosine);
        tau[i] -= pick(there, x[i] * sine * (1.0 - x[3 * nv + i] / length), all(0.0));
    }
}

static void cables(const Tree *t, const Group *g, const V *x, V *p, V *tau)
{
    const int64_t nv = t->nv;
    for (int64_t i = 0; i < nv; i++) {
        V q = g->q[i];
        tau[i] -= x[i] * (q - x[nv + i]) + x[2 * nv + i] * direction(p + i, q, x[3 * nv + i]);
    }
}

/* Torque `tau` (nv) minus that of every law over a step h, in which their states advance. */
static void take_laws(const Tree *t, Group *g, double h, double time, V *tau)
{
    const V *x = g->law;
    V *states = g->states;
    for (int64_t l = 0; l < t->laws; l++) {
        switch (t->law_kind[l]) {
        case STRIBECK: stribeck(t, g, x, tau); break;
        case COUPLED: coupled(t, g, x, tau); break;
        case LUGRE: lugre(t, g, x, states, h, tau); break;
        case FRICTION: friction(t, g, x, states, time, tau); break;
        case PERIODIC: periodic(t, g, x, states, tau); break;
        case GRAVITY_SPRING: gravity_spring(t, g, x, tau); break;
        case CABLES: cables(t, g, x, states, tau); break;
        }
        x += t->law_numbers[l];
        states += t->law_states[l];
    }
}

/* --- Motors ------------------------------------------------------------------------------------ */

static inline V feedback(const Group *g, int64_t k, V u, V q, V v)
{
    return clipped(g->kp[k] * (u - q) - g->kd[k] * v, -g->limit[k], g->limit[k]);
}

/* Rotor of an elastic joint over a step, as turn_rotor and turn_massless of steps.c; where its inertia
 * is zero the motor has none. */
static void turn_rotor(const Tree *t, Group *g, int64_t k, double h)
{
    const int64_t dof = t->motor[k];
    V theta = g->theta[k], rate = g->rate[k], B = g->rotor[k], kp = g->kp[k], kd = g->kd[k];
    V gap = g->gap[k], D = g->damping[k], q = g->q[t->motor_place[k]], v = g->v[dof], u = g->now[k];
    V limit = g->limit[k], x = theta - q, e = u - theta, torque = u;
    x -= clipped(x, -gap, gap);
    V load = g->stiffness[k] * x + D * (rate - v);
    if (t->input != HELD) {
        V next = (B * rate + h * (kp * e - load)) / (B + h * kd + h * h * kp);
        torque = clipped(kp * (e - h * next) - kd * next, -limit, limit);
    }
    V w = rate + h / B * (torque - load);
    I light = B == 0.0;
    if (any(light)) {
        V K = pick((gap > 0.0) & (x == 0.0), all(0.0), g->stiffness[k]), rest = D * v - K * x;
        V own = (kp * e + rest) / (kd + D + h * (kp + K)), free = kp * (e - h * own) - kd * own;
        V held = clipped(free, -limit, limit);
        own = pick((held != free) & (D + h * K > 0.0), (held + rest) / (D + h * K), own);
        w = pick(light, own, w);
        torque = pick(light, held, torque);
        load = pick(light, K * (x + h * own) + D * (own - v), load);
    }
    g->rate[k] = w;
    g->theta[k] = theta + h * w;
    g->given[k] = torque;
    g->applied[dof] += load;
}

/* Torques of the motors on their joints at the state of this step, and what rates at its end add to M:
 * h times the dampers, and the gains of their rate feedback. */
static void drive(const Tree *t, Group *g, double h)
{
    for (int64_t i = 0; i < t->nv; i++) {
        g->motors[i] = all(0.0);
        g->dampers[i] = t->at_end == EXPLICIT ? all(0.0) : h * g->viscous[i];
    }
    for (int64_t k = 0; k < t->nu; k++) {
        const int64_t dof = t->motor[k];
        if (t->elastic) {
            turn_rotor(t, g, k, h);
            continue;
        }
        V force = g->held[k];
        if (t->input != HELD) {
            force = feedback(g, k, g->now[k], g->q[t->motor_place[k]], g->v[dof]);
            /* A motor at its limit, or that of its joint, has no rate feedback. */
            I free = (force > g->low[k]) & (force < g->high[k]);
            if (t->at_end == ALL_DAMPERS)
                g->dampers[dof] += pick(free, h * g->kd[k], all(0.0));
        }
        g->motors[dof] = clipped(force, g->low[k], g->high[k]);
    }
}

/* --- Steps ------------------------------------------------------------------------------------- */

static void turn_quaternion(V *q, const V *w, double h)
{
    V rate = root(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]), s, c;
    sine_cosine(0.5 * h * rate, &s, &c);
    s = pick(rate > 0.0, s / rate, all(0.0));
    V x = s * w[0], y = s * w[1], z = s * w[2];
    V next[4] = {q[0] * c - q[1] * x - q[2] * y - q[3] * z, q[0] * x + q[1] * c + q[2] * z - q[3] * y,
                 q[0] * y - q[1] * z + q[2] * c + q[3] * x, q[0] * z + q[1] * y - q[2] * x + q[3] * c};
    V size = root(next[0] * next[0] + next[1] * next[1] + next[2] * next[2] + next[3] * next[3]);
    for (int i = 0; i < 4; i++)
        q[i] = next[i] / size;
}

static void advance(const Tree *t, Group *g, const V *a, double h)
{
    for (int64_t i = 0; i < t->nv; i++)
        g->v[i] += h * a[i];
    for (int64_t j = 0; j < t->joints; j++) {
        V *q = g->q + t->qadr[j];
        const V *v = g->v + t->vadr[j];
        switch (t->kind[j]) {
        case FREE:
            for (int i = 0; i < 3; i++)
                q[i] += h * v[i];
            turn_quaternion(q + 3, v + 3, h);
            break;
        case BALL: turn_quaternion(q, v, h); break;
        default: q[0] += h * v[0];
        }
    }
}

/* Forces at g->q and g->v and the acceleration that a step applies (nv), which is returned: g->a at
 * its start, or that with the dampers at its end. */
static const V *step(const Tree *t, Group *g, double h, double time)
{
    const size_t bytes = sizeof(V) * (size_t)t->nv;
    for (int64_t i = 0; i < t->nv; i++)
        g->applied[i] = -g->offset[i];
    take_laws(t, g, h, time, g->applied);
    drive(t, g, h);
    dynamics(t, g);
    for (int64_t i = 0; i < t->nv; i++)
        g->force[i] = g->motors[i] + g->applied[i] - g->viscous[i] * g->v[i] - g->bias[i];
    for (int64_t j = 0; j < t->joints; j++)
        if (dofs_of(t->kind[j]) == 1) {
            const int64_t i = t->vadr[j];
            g->force[i] -= g->spring[i] * (g->q[t->qadr[j]] - t->spring_reference[i]);
        }
    if (g->has_coulomb)
        solve_friction(t, g);
    else if (t->at_end == EXPLICIT || t->needs_start) {
        factorise_with(t, g, NULL);
        memcpy(g->a, g->force, bytes);
        solve(t, g, g->L, g->a);
    }
    for (int64_t i = 0; g->has_coulomb && i < t->nv; i++)
        g->force[i] += friction_force(t, g, i, g->a[i]);
    for (int64_t i = 0; t->laws && i < t->nv; i++)
        g->load[i] = g->force[i] + g->bias[i] - g->armature[i] * g->a[i];
    if (t->at_end == EXPLICIT)
        return g->a;
    factorise_with(t, g, g->dampers);
    memcpy(g->solved, g->force, bytes);
    solve(t, g, g->L, g->solved);
    return g->solved;
}

/* Torque of the motors at the end of a step that changed the rates by `change`, as use_end_of_step. */
static V torque_at_end(const Tree *t, const Group *g, int64_t k, int64_t dof, V change)
{
    V tau = g->motors[dof];
    if (k >= 0 && t->input != HELD) {
        I free = (tau > g->low[k]) & (tau < g->high[k]);
        tau -= pick(free, g->kd[k] * change, all(0.0));
    }
    return tau - g->viscous[dof] * change;
}

static inline V gather(const double *x, int64_t stride, int64_t count)
{
    V out;
    for (int64_t l = 0; l < LANES; l++) /* the last plant fills what is left of a group */
        out[l] = x[(l < count ? l : count - 1) * stride];
    return out;
}

/* Arrays of one call: starts q, v (plants, nq or nv), states (plants, number of states), inputs
 * (samples, nu) that all share, or (plants, samples, nu). */
typedef struct {
    int64_t plants, samples, each, own_inputs;
    double h, time;
    const double *numbers; /* (groups, numbers of a plant, LANES) */
    const double *reference; /* posture of the constraints' weights (nq) */
    const double *q, *v, *states, *inputs;
} Call;

/* Signals of the samples in a block are kept in lanes, and then written plant by plant: number by
 * number, to arrays that are far apart, they cost as much as a step (measured). */
#define BLOCK 16

static int64_t width_of(const Tree *t) { return t->nq + 3 * t->nv + (t->elastic ? 3 * t->nu : 0); }

static void record_state(const Tree *t, const Group *g, int64_t k)
{
    V *out = g->block + k % BLOCK * width_of(t);
    memcpy(out, g->q, sizeof(V) * (size_t)t->nq);
    memcpy(out + t->nq, g->v, sizeof(V) * (size_t)t->nv);
    if (t->elastic) {
        out += t->nq + 3 * t->nv;
        memcpy(out, g->theta, sizeof(V) * (size_t)t->nu);
        memcpy(out + t->nu, g->rate, sizeof(V) * (size_t)t->nu);
    }
}

/* Accelerations and torques of a sample, from the acceleration `a` of the step that follows it. */
static void record_step(const Tree *t, const Group *g, double h, const V *a, int64_t k)
{
    V *out = g->block + k % BLOCK * width_of(t) + t->nq + t->nv, *tau = out + t->nv;
    V *of_motors = tau + t->nv + 2 * t->nu;
    for (int64_t i = 0, m = 0; i < t->nv; i++) {
        const int64_t motor = m < t->nu && t->motor[m] == i ? m++ : -1; /* motors are in order */
        out[i] = t->records_end ? a[i] : g->a[i];
        tau[i] = t->records_end ? torque_at_end(t, g, motor, i, h * a[i]) : g->motors[i];
        if (t->elastic && motor >= 0) {
            of_motors[motor] = (g->rate[motor] - g->before[motor]) / h;
            tau[i] = g->given[motor];
        }
    }
}

/* Write the samples of a block up to k. */
static void write_block(const Tree *t, const Group *g, const Call *c, const Record *out,
                        int64_t first, int64_t count, int64_t k)
{
    double *const signals[] = {out->q, out->v, out->a, out->tau,
                               out->motor_q, out->motor_v, out->motor_a};
    const int64_t start = k - k % BLOCK, width = width_of(t);
    const double *from = (const double *)g->block;
    for (int s = 0; s < (t->elastic ? 7 : 4); s++) {
        const int64_t own = s == 0 ? t->nq : s < 4 ? t->nv : t->nu;
        for (int64_t l = 0; l < count; l++) {
            double *to = signals[s] + ((first + l) * c->samples + start) * own;
            for (int64_t r = 0; r <= k - start; r++)
                for (int64_t i = 0; i < own; i++)
                    *to++ = from[(r * width + i) * LANES + l];
        }
        from += own * LANES;
    }
}

/* Inputs of a sample's step: at the share `part` of the way to the next sample. */
static void read_inputs(const Tree *t, const Group *g, const Call *c, int64_t first, int64_t count,
                        int64_t k, double part)
{
    const int64_t stride = c->own_inputs ? c->samples * t->nu : 0;
    const double *u = c->inputs + first * stride + k * t->nu;
    for (int64_t m = 0; m < t->nu; m++) {
        V now = stride ? gather(u + m, stride, count) : all(u[m]);
        if (part > 0.0 && k + 1 < c->samples)
            now += part * ((stride ? gather(u + t->nu + m, stride, count) : all(u[t->nu + m])) - now);
        g->now[m] = now;
    }
}

static void run_group(const Tree *t, Group *g, const Call *c, const Record *out, int64_t first)
{
    const int64_t count = c->plants - first < LANES ? c->plants - first : LANES;
    for (int64_t i = 0; i < t->nq; i++)
        g->q[i] = all(c->reference[i]);
    if (g->has_coulomb)
        reference_inertia(t, g);
    for (int64_t i = 0; i < t->nq; i++)
        g->q[i] = gather(c->q + first * t->nq + i, t->nq, count);
    for (int64_t i = 0; i < t->nv; i++) {
        g->v[i] = gather(c->v + first * t->nv + i, t->nv, count);
        g->a[i] = g->load[i] = all(0.0);
    }
    for (int64_t m = 0; m < t->nu; m++) { /* aligned with their joints, the transmission relaxed */
        g->theta[m] = g->q[t->motor_place[m]];
        g->rate[m] = g->v[t->motor[m]];
    }
    for (int64_t k = 0; k < c->samples; k++) {
        record_state(t, g, k);
        read_inputs(t, g, c, first, count, k, 0.0);
        for (int64_t m = 0; t->input == HELD && m < t->nu; m++) {
            const int64_t dof = t->motor[m];
            V q = t->elastic ? g->theta[m] : g->q[t->motor_place[m]];
            V v = t->elastic ? g->rate[m] : g->v[dof];
            g->held[m] = feedback(g, m, g->now[m], q, v);
        }
        for (int64_t i = 0; i < c->each; i++) {
            if (t->input == INTERPOLATED && i > 0)
                read_inputs(t, g, c, first, count, k, (double)i / (double)c->each);
            for (int64_t m = 0; m < t->nu; m++) {
                g->before[m] = g->rate[m];
                if (t->input == HELD)
                    g->now[m] = g->held[m];
            }
            const V *a = step(t, g, c->h, c->time + (double)(k * c->each + i) * c->h);
            if (i == 0)
                record_step(t, g, c->h, a, k);
            advance(t, g, a, c->h);
        }
        if (k % BLOCK == BLOCK - 1 || k == c->samples - 1)
            write_block(t, g, c, out, first, count, k);
    }
}

/* --- Memory ------------------------------------------------------------------------------------ */

static int64_t numbers_of(const Tree *t)
{
    int64_t laws = 0;
    for (int64_t l = 0; l < t->laws; l++)
        laws += t->law_numbers[l];
    return 10 * t->joints + 5 * t->nv + (t->elastic ? 9 : 5) * t->nu + laws;
}

static int64_t states_of(const Tree *t)
{
    int64_t states = 0;
    for (int64_t l = 0; l < t->laws; l++)
        states += t->law_states[l];
    return states;
}

/* Numbers of the packed M, and where its rows begin; `row` and `before` may be NULL. */
static int64_t packed(const Tree *t, int64_t *row, int64_t *before)
{
    int64_t total = 0;
    for (int64_t j = 0; j < t->joints; j++) {
        int64_t depth = 0, last = -1;
        for (int64_t at = t->before[j]; at >= 0; at = t->before[at])
            depth += dofs_of(t->kind[at]);
        if (t->before[j] >= 0)
            last = t->vadr[t->before[j]] + dofs_of(t->kind[t->before[j]]) - 1;
        for (int64_t k = 0; k < dofs_of(t->kind[j]); k++) {
            const int64_t dof = t->vadr[j] + k;
            if (row) {
                row[dof] = total;
                before[dof] = k ? dof - 1 : last;
            }
            total += depth + k + 1;
        }
    }
    if (row)
        row[t->nv] = total;
    return total;
}

/* Bytes of scratch memory. */
EXPORT int64_t LEVELLED(work)(const Tree *t)
{
    const int64_t numbers = numbers_of(t) + states_of(t) + t->nq + 14 * t->nv + 6 * t->nu
                          + 2 * packed(t, NULL, NULL) + BLOCK * width_of(t);
    return 64 + (int64_t)sizeof(V) * (numbers + t->nv) + 8 * (2 * t->nv + 8)
         + (int64_t)sizeof(Frame) * t->joints;
}

static V *cut(V **from, int64_t count)
{
    V *start = *from;
    *from += count;
    return start;
}

static void lay_out(const Tree *t, Group *g, void *memory)
{
    V *free = (V *)(((uintptr_t)memory + 63) & ~(uintptr_t)63);
    const int64_t nv = t->nv, nu = t->nu, size = packed(t, NULL, NULL);
    V **own[] = {&g->v, &g->a, &g->bias, &g->force, &g->motors, &g->applied, &g->load, &g->end,
                 &g->solved, &g->side, &g->inverse_inertia, &g->product, &g->move, &g->dampers};
    V **of_motors[] = {&g->now, &g->held, &g->theta, &g->rate, &g->before, &g->given};
    const V **of_plants[] = {&g->armature, &g->viscous, &g->coulomb, &g->spring, &g->offset};
    const V **gains[] = {&g->kp, &g->kd, &g->limit, &g->low, &g->high,
                         &g->stiffness, &g->damping, &g->gap, &g->rotor};
    g->frames = (Frame *)cut(&free, t->joints * (int64_t)(sizeof(Frame) / sizeof(V)));
    g->inertia = cut(&free, 10 * t->joints);
    for (size_t i = 0; i < sizeof of_plants / sizeof *of_plants; i++)
        *of_plants[i] = cut(&free, nv);
    for (size_t i = 0; i < (t->elastic ? 9 : 5); i++)
        *gains[i] = cut(&free, nu);
    g->law = free;
    cut(&free, numbers_of(t) - (g->law - g->inertia));
    g->states = cut(&free, states_of(t));
    g->q = cut(&free, t->nq);
    for (size_t i = 0; i < sizeof own / sizeof *own; i++)
        *own[i] = cut(&free, nv);
    for (size_t i = 0; i < sizeof of_motors / sizeof *of_motors; i++)
        *of_motors[i] = cut(&free, nu);
    g->M = cut(&free, size);
    g->L = cut(&free, size);
    g->block = cut(&free, BLOCK * width_of(t));
    g->sticks = (I *)cut(&free, nv);
    g->dof_before = (int64_t *)free;
    g->row = g->dof_before + nv;
    packed(t, g->row, g->dof_before);
}

EXPORT int64_t LEVELLED(lanes)(void) { return LANES; }

/* Simulate c->plants from their starts on. */
EXPORT void LEVELLED(run)(const Tree *t, const Call *c, const Record *out, void *memory)
{
    Group g;
    lay_out(t, &g, memory);
    const int64_t numbers = numbers_of(t), states = states_of(t);
    for (int64_t first = 0; first < c->plants; first += LANES) {
        const int64_t count = c->plants - first < LANES ? c->plants - first : LANES;
        memcpy((void *)g.inertia, c->numbers + first * numbers, sizeof(V) * (size_t)numbers);
        for (int64_t s = 0; s < states; s++)
            g.states[s] = gather(c->states + first * states + s, states, count);
        I found = (I){0};
        for (int64_t i = 0; i < t->nv; i++)
            found |= g.coulomb[i] > 0.0;
        g.has_coulomb = any(found);
        run_group(t, &g, c, out, first);
    }
}

#ifdef SOURCE_HASH
#define TEXT_(x) #x
#define TEXT(x) TEXT_(x)
EXPORT const char *lanes_source(void) { return TEXT(SOURCE_HASH); }

EXPORT int kernel_runs(const char *level)
{
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (!strcmp(level, "v4"))
        return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl")
            && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq");
    if (!strcmp(level, "v3"))
        return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
    return !strcmp(level, "base");
}
#endif
