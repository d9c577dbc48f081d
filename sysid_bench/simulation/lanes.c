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

#include "../vectors.h"

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
    int64_t most_pieces;         /* of friction that sticks, in one step */
} Tree;

/* Signals of each plant (plants, samples, nq or nv or nu), as simulation_steps in steps.c. */
typedef struct {
    double *q, *v, *a, *tau, *motor_q, *motor_v, *motor_a;
    int64_t *unsolved; /* (plants): steps whose friction was not solved */
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
    I unsolved; /* steps whose friction has no solution after the most pieces, lane by lane */
    int64_t *dof_before, *row;                                   /* (nv), (nv + 1) */
    Frame *frames;
    int64_t has_coulomb;
} Group;

/* --- Numbers in lanes -------------------------------------------------------------------------- */

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

/* Symmetric matrix xx xy xz yy yz zz times a vector. */
static inline V3 times(const V *J, V3 x)
{
    return (V3){J[0] * x.x + J[1] * x.y + J[2] * x.z, J[1] * x.x + J[3] * x.y + J[4] * x.z,
                J[2] * x.x + J[4] * x.y + J[5] * x.z};
}

/* --- Kinematics, bias and mass matrix ---------------------------------------------------------- */

static int dofs_of(int64_t kind) { return kind == FREE ? 6 : kind == BALL ? 3 : 1; }

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
        quaternion_matrix(Q, q[0], q[1], q[2], q[3]);
        for (int i = 0; i < 9; i += 3)
            for (int k = 0; k < 3; k++)
                f->R[i + k] = R0[i] * Q[k] + R0[i + 1] * Q[3 + k] + R0[i + 2] * Q[6 + k];
        break;
    case FREE: quaternion_matrix(f->R, q[3], q[4], q[5], q[6]); break; /* of its position nothing depends */
    }
}

/* Rates of a joint's frame at joint accelerations `a` (NULL: zero; else hinges and slides alone). */
static inline void move(const Tree *t, int64_t j, const V *v, const V *a, const Frame *before,
                        Frame *f)
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
        if (a)
            alpha.z += a[0];
        break;
    case SLIDE: /* Coriolis */
        d.x += 2.0 * w.y * v[0];
        d.y -= 2.0 * w.x * v[0];
        if (a)
            d.z += a[0];
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
}

static inline void carry(const V *inertia, Frame *f)
{
    f->m = inertia[0];
    f->h = (V3){inertia[1], inertia[2], inertia[3]};
    memcpy(f->J, inertia + 4, sizeof f->J);
}

/* What moves the body of a frame, of its own inertia alone. */
static inline void own_wrench(Frame *f)
{
    f->force = add(scaled(f->d, f->m), swing(f->w, f->alpha, f->h));
    f->moment = add(add(times(f->J, f->alpha), cross(f->w, times(f->J, f->w))), cross(f->h, f->d));
}

/* Add the force and moment on a frame to those on the frame before. */
static inline void join_wrenches(const Frame *f, Frame *to)
{
    V3 force = turn(f->R, f->force);
    to->force = add(to->force, force);
    to->moment = add(to->moment, add(turn(f->R, f->moment), cross(f->p, force)));
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
        Frame *f = g->frames + j, *before = t->before[j] < 0 ? NULL : g->frames + t->before[j];
        carry(g->inertia + 10 * j, f);
        place(t, j, g->q + t->qadr[j], f);
        move(t, j, g->v + t->vadr[j], NULL, before, f);
        own_wrench(f);
    }
    for (int64_t j = t->joints - 1; j >= 0; j--) {
        Frame *f = g->frames + j;
        components(t, j, f, f->force, f->moment, g->bias + t->vadr[j]);
        mass_rows(t, g, j);
        if (t->before[j] < 0)
            continue;
        join_wrenches(f, g->frames + t->before[j]);
        join_bodies(f, g->frames + t->before[j]);
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

/* Acceleration (nv) of M a = force + f(a), from that of the step before on. Lanes that have not ended
 * after the most pieces are counted: their acceleration does not solve the equation. */
static void solve_friction(const Tree *t, Group *g)
{
    const size_t bytes = sizeof(V) * (size_t)t->nv;
    for (int64_t i = 0; i < t->nv; i++)
        g->sticks[i] = (I){0} - 1; /* no piece: the first one is new */
    I open = (I){0} - 1;
    for (int64_t k = 0; k < t->most_pieces; k++) {
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
    open &= pieces(t, g, g->solved);
    g->unsolved += open & 1;
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

/* Numbers of sample k in a block, which holds one signal after the other: that of `number` numbers
 * before it in a sample, with `own` numbers. */
static inline V *block_place(const Group *g, int64_t number, int64_t own, int64_t k)
{
    return g->block + BLOCK * number + k % BLOCK * own;
}

static void record_state(const Tree *t, const Group *g, int64_t k)
{
    const int64_t nq = t->nq, nv = t->nv, nu = t->nu, motors = nq + 3 * nv;
    memcpy(block_place(g, 0, nq, k), g->q, sizeof(V) * (size_t)nq);
    memcpy(block_place(g, nq, nv, k), g->v, sizeof(V) * (size_t)nv);
    if (t->elastic) {
        memcpy(block_place(g, motors, nu, k), g->theta, sizeof(V) * (size_t)nu);
        memcpy(block_place(g, motors + nu, nu, k), g->rate, sizeof(V) * (size_t)nu);
    }
}

/* Accelerations and torques of a sample, from the acceleration `a` of the step that follows it. */
static void record_step(const Tree *t, const Group *g, double h, const V *a, int64_t k)
{
    const int64_t nv = t->nv, before = t->nq + nv;
    V *out = block_place(g, before, nv, k), *tau = block_place(g, before + nv, nv, k);
    V *of_motors = block_place(g, before + 2 * nv + 2 * t->nu, t->nu, k);
    for (int64_t i = 0, m = 0; i < nv; i++) {
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
    const int64_t start = k - k % BLOCK;
    int64_t number = 0;
    for (int s = 0; s < (t->elastic ? 7 : 4); s++) {
        const int64_t own = s == 0 ? t->nq : s < 4 ? t->nv : t->nu;
        const int64_t size = (k - start + 1) * own, plant = c->samples * own;
        const V *from = block_place(g, number, own, 0);
        double *to = signals[s] + first * plant + start * own;
        int64_t i = 0;
        for (; count == LANES && i + LANES <= size; i += LANES)
            transpose(from + i, 1, to + i, plant);
        for (int64_t l = 0; l < count; l++)
            for (int64_t r = i; r < size; r++)
                to[l * plant + r] = from[r][l];
        number += own;
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
    g->unsolved = (I){0};
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
    for (int64_t l = 0; l < count; l++)
        out->unsolved[first + l] = g->unsolved[l];
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

/* --- Steps of a model along measured torques --------------------------------------------------- */

/* A model of hinges and slides whose numbers, [inertias (joints, 10), armature, viscous, coulomb,
 * spring, offset (nv)], are `known` plus `weight` times a base parameter at each `place` (those of
 * parameter j are first[j] .. first[j + 1]): any numbers, also such as no body has. It runs along
 * `tau` (samples, nv). The base parameters `column` follow the measured motion by their part
 * `friction` (samples, nv, columns) of the torque, and joints that are `standing` (samples, nv) at
 * both ends of a step follow `measured_a` (samples, nv); those that are `jumping` (r) with the state
 * have no derivative by it. `nudge`: finite-difference step of q and v. */
typedef struct {
    int64_t r, substeps, columns, stands;
    double dt, nudge, far;
    const double *known, *weight;
    const int64_t *first, *place, *column, *follows, *jumping, *standing;
    const double *tau, *friction, *measured_a;
} Model;

enum { DONE, SINGULAR, DIVERGED };

/* Add the numbers of base parameters beta (r); those that are `skipped` (r) are left out. */
static void add_numbers(const Model *m, const int64_t *skipped, V *numbers, const V *beta)
{
    for (int64_t j = 0; j < m->r; j++)
        for (int64_t e = m->first[j]; !skipped[j] && e < m->first[j + 1]; e++)
            numbers[m->place[e]] += m->weight[e] * beta[j];
}

static void use_numbers(const Tree *t, Group *g, const V *numbers)
{
    const V *terms = numbers + 10 * t->joints;
    g->inertia = numbers;
    g->armature = terms, g->viscous = terms + t->nv, g->coulomb = terms + 2 * t->nv;
    g->spring = terms + 3 * t->nv, g->offset = terms + 4 * t->nv;
}

/* Torque (nv) of joint terms but for the rotors' inertia. */
static inline V term_torque(const Tree *t, const Group *g, int64_t j)
{
    const int64_t i = t->vadr[j];
    V v = g->v[i], direction = pick(v > 0.0, all(1.0), pick(v < 0.0, all(-1.0), all(0.0)));
    return g->viscous[i] * v + g->coulomb[i] * direction + g->offset[i]
         + g->spring[i] * (g->q[t->qadr[j]] - t->spring_reference[i]);
}

/* Frames at q, v and accelerations a, of whatever inertia. */
static void kinematics(const Tree *t, Group *g, const V *a)
{
    for (int64_t j = 0; j < t->joints; j++) {
        Frame *f = g->frames + j, *before = t->before[j] < 0 ? NULL : g->frames + t->before[j];
        place(t, j, g->q + t->qadr[j], f);
        move(t, j, g->v + t->vadr[j], a + t->vadr[j], before, f);
    }
}

/* Inverse dynamics tau (nv) of the numbers in use, after `kinematics`. */
static void inverse_dynamics(const Tree *t, Group *g, const V *a, V *tau)
{
    for (int64_t j = 0; j < t->joints; j++) {
        carry(g->inertia + 10 * j, g->frames + j);
        own_wrench(g->frames + j);
    }
    for (int64_t j = t->joints - 1; j >= 0; j--) {
        const int64_t i = t->vadr[j];
        const Frame *f = g->frames + j;
        components(t, j, f, f->force, f->moment, tau + i);
        tau[i] += g->armature[i] * a[i] + term_torque(t, g, j);
        if (t->before[j] >= 0)
            join_wrenches(f, g->frames + t->before[j]);
    }
}

/* M (nv, nv) of one lane, from the packed one. */
static void unpack(const Tree *t, const Group *g, int64_t lane, double *M)
{
    memset(M, 0, 8 * (size_t)(t->nv * t->nv));
    for (int64_t k = 0; k < t->nv; k++) {
        const V *own = g->M + g->row[k];
        for (int64_t i = k; i >= 0; i = g->dof_before[i], own++)
            M[k * t->nv + i] = M[i * t->nv + k] = (*own)[lane];
    }
}

/* LU of A (n, n) in place with row pivots, as LAPACK's; 0 where it is singular. */
static int factorise_dense(int64_t n, double *A, int64_t *pivot)
{
    for (int64_t k = 0; k < n; k++) {
        pivot[k] = k;
        for (int64_t i = k + 1; i < n; i++)
            if (fabs(A[i * n + k]) > fabs(A[pivot[k] * n + k]))
                pivot[k] = i;
        if (A[pivot[k] * n + k] == 0.0)
            return 0;
        for (int64_t l = 0; pivot[k] != k && l < n; l++) {
            double x = A[k * n + l];
            A[k * n + l] = A[pivot[k] * n + l];
            A[pivot[k] * n + l] = x;
        }
        for (int64_t i = k + 1; i < n; i++) {
            const double share = A[i * n + k] /= A[k * n + k];
            for (int64_t l = k + 1; l < n; l++)
                A[i * n + l] -= share * A[k * n + l];
        }
    }
    return 1;
}

/* X (n, m) of A X = X. */
static void solve_dense(int64_t n, const double *A, const int64_t *pivot, int64_t m, double *X)
{
    for (int64_t k = 0; k < n; k++) {
        for (int64_t c = 0; pivot[k] != k && c < m; c++) {
            double x = X[k * m + c];
            X[k * m + c] = X[pivot[k] * m + c];
            X[pivot[k] * m + c] = x;
        }
        for (int64_t i = k + 1; i < n; i++)
            for (int64_t c = 0; c < m; c++)
                X[i * m + c] -= A[i * n + k] * X[k * m + c];
    }
    for (int64_t k = n - 1; k >= 0; k--) {
        for (int64_t i = k + 1; i < n; i++)
            for (int64_t c = 0; c < m; c++)
                X[k * m + c] -= A[k * n + i] * X[i * m + c];
        for (int64_t c = 0; c < m; c++)
            X[k * m + c] /= A[k * n + k];
    }
}

/* Rows of joints that stand still, in a system M x = X (nv, m): x is `value` there. */
static int hold(const Tree *t, const Model *m, int64_t at, double *M, double *x)
{
    int held = 0;
    for (int64_t i = 0; m->stands && i < t->nv; i++) {
        const int64_t here = at * t->nv + i, next = here + t->nv;
        if (!m->standing[here] || !m->standing[next])
            continue;
        memset(M + i * t->nv, 0, 8 * (size_t)t->nv);
        M[i * t->nv + i] = 1.0;
        x[i] = 0.5 * (m->measured_a[here] + m->measured_a[next]);
        held = 1;
    }
    return held;
}

/* Memory of the functions below, cut into their arrays. */
typedef struct {
    V *rigid, *smooth, *beta, *torque, *rates, *a, *b, *tau, *q, *v; /* numbers; (r); (nv) */
    double *M, *solved, *x, *state, *Y, *da, *db, *dq, *dv; /* (nv, nv); (nv, r); (nv, 2 nv + r) */
    int64_t *pivot, *none;
} Desk;

static int64_t cut_desk(const Tree *t, const Model *m, char *memory, Desk *d)
{
    const int64_t nv = t->nv, numbers = 10 * t->joints + 5 * nv, width = 2 * nv + m->r;
    int64_t used = 0;
    V **lanes[] = {&d->rigid, &d->smooth, &d->beta, &d->torque, &d->rates, &d->a, &d->b, &d->tau,
                   &d->q, &d->v};
    double **plain[] = {&d->M, &d->solved, &d->x, &d->state, &d->Y,
                        &d->da, &d->db, &d->dq, &d->dv};
    const int64_t of_lanes[] = {numbers, numbers, m->r, 2 * nv, nv, nv, nv, nv, nv, nv};
    const int64_t of_plain[] = {nv * nv, nv * nv, nv, 4 * nv, nv * m->r,
                                nv * width, nv * width, nv * width, nv * width};
    for (size_t i = 0; i < sizeof lanes / sizeof *lanes; i++) {
        *lanes[i] = (V *)(memory + used);
        used += (int64_t)sizeof(V) * of_lanes[i];
    }
    for (size_t i = 0; i < sizeof plain / sizeof *plain; i++) {
        *plain[i] = (double *)(memory + used);
        used += (8 * of_plain[i] + 63) / 64 * 64;
    }
    d->pivot = (int64_t *)(memory + used);
    d->none = d->pivot + nv;
    return used + 8 * (nv + m->r);
}

EXPORT int64_t LEVELLED(model_work)(const Tree *t, const Model *m)
{
    Desk d;
    return LEVELLED(work)(t) + 128 + cut_desk(t, m, NULL, &d);
}

static void set_up(const Tree *t, const Model *m, void *memory, Group *g, Desk *d)
{
    lay_out(t, g, memory);
    char *after = (char *)memory + LEVELLED(work)(t);
    cut_desk(t, m, (char *)(((uintptr_t)after + 63) & ~(uintptr_t)63), d);
    memset(d->none, 0, 8 * (size_t)m->r);
}

/* Measured torque (nv) at sample k less the friction of beta, in lanes. */
static void driving_torque(const Tree *t, const Model *m, int64_t k, const V *beta, V *tau)
{
    for (int64_t i = 0; i < t->nv; i++) {
        const double *part = m->friction + (k * t->nv + i) * m->columns;
        tau[i] = all(m->tau[k * t->nv + i]);
        for (int64_t c = 0; c < m->columns; c++)
            tau[i] -= part[c] * beta[m->column[c]];
    }
}

/* Acceleration a (nv) of the plants in lanes at g->q and g->v, under the torque d->tau. */
static int accelerate(const Tree *t, const Model *m, Group *g, Desk *d, int64_t at, V *a)
{
    I fine = (I){0} - 1;
    dynamics(t, g);
    for (int64_t j = 0; j < t->joints; j++) {
        const int64_t i = t->vadr[j];
        a[i] = d->tau[i] - g->bias[i] - term_torque(t, g, j);
    }
    if (!m->stands) {
        factorise_with(t, g, NULL);
        for (int64_t k = 0; k < t->nv; k++)
            fine &= (g->L[g->row[k]] > 0.0) & (g->L[g->row[k]] < (double)INFINITY);
        if (!any(~fine)) { /* positive definite: no pivots are needed */
            solve(t, g, g->L, a);
            return 1;
        }
    }
    for (int64_t l = 0; l < LANES; l++) {
        for (int64_t i = 0; i < t->nv; i++)
            d->x[i] = a[i][l];
        unpack(t, g, l, d->solved);
        hold(t, m, at, d->solved, d->x);
        if (!factorise_dense(t->nv, d->solved, d->pivot))
            return 0;
        solve_dense(t->nv, d->solved, d->pivot, 1, d->x);
        for (int64_t i = 0; i < t->nv; i++)
            a[i][l] = d->x[i];
    }
    return 1;
}

static int invert(const Tree *t, Desk *d, double *inverse)
{
    const int64_t nv = t->nv;
    if (!factorise_dense(nv, d->M, d->pivot))
        return 0;
    memset(inverse, 0, 8 * (size_t)(nv * nv));
    for (int64_t i = 0; i < nv; i++)
        inverse[i * nv + i] = 1.0;
    solve_dense(nv, d->M, d->pivot, nv, inverse);
    return 1;
}

/* States (count, 2 nv + r), [q v beta], one sample after sample k by Heun's rule, into `moved`
 * (count, 2 nv); M^-1 (nv, nv) of the first one before the step. */
EXPORT int64_t LEVELLED(predict)(const Tree *t, const Model *m, int64_t count, int64_t k,
                                 const double *states, double *moved, double *inverse, void *memory)
{
    Group g;
    Desk d;
    set_up(t, m, memory, &g, &d);
    const int64_t nv = t->nv, width = 2 * nv + m->r;
    const double h = m->dt / (double)m->substeps;
    for (int64_t first = 0; first < count; first += LANES) {
        const int64_t own = count - first < LANES ? count - first : LANES;
        const double *x = states + first * width;
        for (int64_t j = 0; j < m->r; j++)
            d.beta[j] = gather(x + 2 * nv + j, width, own);
        for (int64_t i = 0; i < 10 * t->joints + 5 * nv; i++)
            d.rigid[i] = all(m->known[i]);
        add_numbers(m, m->follows, d.rigid, d.beta);
        use_numbers(t, &g, d.rigid);
        driving_torque(t, m, k, d.beta, d.torque);
        driving_torque(t, m, k + 1, d.beta, d.torque + nv);
        for (int64_t i = 0; i < nv; i++)
            d.q[i] = gather(x + i, width, own), d.v[i] = gather(x + nv + i, width, own);
        for (int64_t part = 0; part < 2 * m->substeps; part++) {
            const int end = part % 2;
            const double share = (double)(part / 2 + end) / (double)m->substeps;
            for (int64_t i = 0; i < nv; i++) {
                d.tau[i] = d.torque[i] + share * (d.torque[nv + i] - d.torque[i]);
                g.q[i] = end ? d.q[i] + h * d.v[i] + 0.5 * h * h * d.a[i] : d.q[i];
                g.v[i] = end ? d.v[i] + h * d.a[i] : d.v[i];
            }
            if (!accelerate(t, m, &g, &d, k, end ? d.b : d.a))
                return SINGULAR;
            if (inverse && first == 0 && part == 0) {
                unpack(t, &g, 0, d.M);
                if (!invert(t, &d, inverse))
                    return SINGULAR;
            }
            for (int64_t i = 0; end && i < nv; i++) { /* of linearly interpolated accelerations */
                d.q[i] += h * d.v[i] + h * h / 6.0 * (2.0 * d.a[i] + d.b[i]);
                d.v[i] += 0.5 * h * (d.a[i] + d.b[i]);
            }
        }
        for (int64_t i = 0; i < nv; i++) {
            if (any(~((size_of(d.q[i]) < m->far) & (size_of(d.v[i]) < m->far))))
                return DIVERGED;
            for (int64_t l = 0; l < own; l++) {
                moved[(first + l) * 2 * nv + i] = d.q[i][l];
                moved[(first + l) * 2 * nv + nv + i] = d.v[i][l];
            }
        }
    }
    return DONE;
}

/* Y (nv, r) at one state q, v (nv) and acceleration in all lanes of a: a base parameter in each lane. */
static void columns(const Tree *t, const Model *m, Group *g, Desk *d, const V *a, double *Y)
{
    const int64_t numbers = 10 * t->joints + 5 * t->nv;
    kinematics(t, g, a);
    use_numbers(t, g, d->smooth);
    for (int64_t first = 0; first < m->r; first += LANES) {
        memset(d->smooth, 0, sizeof(V) * (size_t)numbers);
        const int64_t own = m->r - first < LANES ? m->r - first : LANES;
        for (int64_t l = 0; l < own; l++)
            for (int64_t e = m->first[first + l]; e < m->first[first + l + 1]; e++)
                d->smooth[m->place[e]][l] = m->weight[e];
        inverse_dynamics(t, g, a, d->rates);
        for (int64_t i = 0; i < t->nv; i++)
            for (int64_t l = 0; l < own; l++)
                Y[i * m->r + first + l] = d->rates[i][l];
    }
}

/* Base regressor Y (nv, r) and torque (nv) of the known numbers at one sample q, v, a (nv). */
EXPORT int64_t LEVELLED(model_rows)(const Tree *t, const Model *m, const double *q, const double *v,
                                    const double *a, double *Y, double *known, void *memory)
{
    Group g;
    Desk d;
    set_up(t, m, memory, &g, &d);
    for (int64_t i = 0; i < t->nv; i++)
        g.q[i] = all(q[i]), g.v[i] = all(v[i]), d.a[i] = all(a[i]);
    columns(t, m, &g, &d, d.a, Y);
    for (int64_t i = 0; i < 10 * t->joints + 5 * t->nv; i++)
        d.smooth[i] = all(m->known[i]);
    inverse_dynamics(t, &g, d.a, d.rates);
    for (int64_t i = 0; i < t->nv; i++)
        known[i] = d.rates[i][0];
    return DONE;
}

/* Acceleration a (nv) at one state and its derivative da (nv, width), of a state with the derivatives
 * dq and dv; `share`: how far from sample `at` to the next. */
static int slopes(const Tree *t, const Model *m, Group *g, Desk *d, int64_t at, double share,
                  const double *q, const double *v, const double *dq, const double *dv, double *a,
                  double *da)
{
    const int64_t nv = t->nv, width = 2 * nv + m->r, numbers = 10 * t->joints + 5 * nv;
    for (int64_t i = 0; i < nv; i++) {
        g->q[i] = all(q[i]), g->v[i] = all(v[i]);
        d->tau[i] = d->torque[i] + share * (d->torque[nv + i] - d->torque[i]);
    }
    use_numbers(t, g, d->rigid);
    dynamics(t, g);
    for (int64_t j = 0; j < t->joints; j++) {
        const int64_t i = t->vadr[j];
        a[i] = (d->tau[i] - g->bias[i] - term_torque(t, g, j))[0];
    }
    unpack(t, g, 0, d->M);
    memcpy(d->solved, d->M, 8 * (size_t)(nv * nv));
    hold(t, m, at, d->solved, a);
    if (!factorise_dense(nv, d->solved, d->pivot))
        return 0;
    solve_dense(nv, d->solved, d->pivot, 1, a);
    for (int64_t i = 0; i < nv; i++)
        d->a[i] = all(a[i]);
    columns(t, m, g, d, d->a, d->Y);
    for (int64_t i = 0; i < numbers; i++)
        d->smooth[i] = all(m->known[i]);
    add_numbers(m, m->jumping, d->smooth, d->beta);
    memset(da, 0, 8 * (size_t)(nv * width));
    /* The torque at the state, and at 2 nv states beside it: one in each lane. */
    for (int64_t first = 0; first <= 2 * nv; first += LANES) {
        for (int64_t i = 0; i < nv; i++) {
            g->q[i] = all(q[i]), g->v[i] = all(v[i]);
            if (i + 1 >= first && i + 1 < first + LANES)
                g->q[i][i + 1 - first] += m->nudge;
            if (nv + i + 1 >= first && nv + i + 1 < first + LANES)
                g->v[i][nv + i + 1 - first] += m->nudge;
        }
        kinematics(t, g, d->a);
        inverse_dynamics(t, g, d->a, d->rates);
        for (int64_t i = 0; i < nv; i++) {
            if (first == 0)
                d->x[i] = d->rates[i][0];
            for (int64_t l = first == 0; l < LANES && first + l <= 2 * nv; l++) {
                const double slope = (d->rates[i][l] - d->x[i]) / m->nudge;
                const int64_t by = (first + l - 1) % nv;
                const double *of = (first + l <= nv ? dq : dv) + by * width;
                for (int64_t c = 0; c < width; c++)
                    da[i * width + c] += slope * of[c];
            }
        }
    }
    for (int64_t i = 0; i < nv; i++) {
        const double *here = m->friction + (at * nv + i) * m->columns, *next = here + nv * m->columns;
        for (int64_t c = 0; c < m->columns; c++)
            d->Y[i * m->r + m->column[c]] = (1.0 - share) * here[c] + share * next[c];
        for (int64_t c = 0; c < m->r; c++)
            da[i * width + 2 * nv + c] += d->Y[i * m->r + c];
        const int64_t k = at * nv + i;
        if (m->stands && m->standing[k] && m->standing[k + nv]) /* whatever state and beta are */
            memset(da + i * width, 0, 8 * (size_t)width);
    }
    solve_dense(nv, d->solved, d->pivot, width, da);
    for (int64_t i = 0; i < nv * width; i++)
        da[i] = -da[i];
    return 1;
}

/* States q, v (count, nv) of one beta (r) and their derivatives dq, dv (count, nv, 2 nv + r), one
 * sample after the samples `at` (count) by Heun's rule, in place; M^-1 (nv, nv) of the first one. */
EXPORT int64_t LEVELLED(sensitivities)(const Tree *t, const Model *m, int64_t count,
                                       const int64_t *at, const double *beta, double *q, double *v,
                                       double *dq, double *dv, double *inverse, void *memory)
{
    Group g;
    Desk d;
    set_up(t, m, memory, &g, &d);
    const int64_t nv = t->nv, size = nv * (2 * nv + m->r);
    const double h = m->dt / (double)m->substeps, half = 0.5 * h * h, sixth = h * h / 6.0;
    double *a = d.state, *b = a + nv, *q1 = b + nv, *v1 = q1 + nv;
    for (int64_t j = 0; j < m->r; j++)
        d.beta[j] = all(beta[j]);
    for (int64_t i = 0; i < 10 * t->joints + 5 * nv; i++)
        d.rigid[i] = all(m->known[i]);
    add_numbers(m, m->follows, d.rigid, d.beta);
    for (int64_t s = 0; s < count; s++, q += nv, v += nv, dq += size, dv += size) {
        driving_torque(t, m, at[s], d.beta, d.torque);
        driving_torque(t, m, at[s] + 1, d.beta, d.torque + nv);
        for (int64_t part = 0; part < m->substeps; part++) {
            const double from = (double)part / (double)m->substeps;
            const double to = (double)(part + 1) / (double)m->substeps;
            if (!slopes(t, m, &g, &d, at[s], from, q, v, dq, dv, a, d.da))
                return SINGULAR;
            if (inverse && s == 0 && part == m->substeps - 1 && !invert(t, &d, inverse))
                return SINGULAR;
            for (int64_t i = 0; i < nv; i++) {
                q1[i] = q[i] + h * v[i] + half * a[i];
                v1[i] = v[i] + h * a[i];
            }
            for (int64_t i = 0; i < size; i++) {
                d.dq[i] = dq[i] + h * dv[i] + half * d.da[i];
                d.dv[i] = dv[i] + h * d.da[i];
            }
            if (!slopes(t, m, &g, &d, at[s], to, q1, v1, d.dq, d.dv, b, d.db))
                return SINGULAR;
            for (int64_t i = 0; i < nv; i++) {
                q[i] += h * v[i] + sixth * (2.0 * a[i] + b[i]);
                v[i] += 0.5 * h * (a[i] + b[i]);
            }
            for (int64_t i = 0; i < size; i++) {
                dq[i] += h * dv[i] + sixth * (2.0 * d.da[i] + d.db[i]);
                dv[i] += 0.5 * h * (d.da[i] + d.db[i]);
            }
        }
    }
    return DONE;
}

#ifdef SOURCE_HASH
EXPORT const char *lanes_source(void) { return TEXT(SOURCE_HASH); }
#endif
