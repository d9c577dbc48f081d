/* The tree kernel in C: the same Y as kernel.py, structure of arrays over blocks of samples.
 *
 * No dependency but the C library; compiled per instruction set (LEVEL), for blocks and for few
 * samples (FEW), chosen at run time.
 * Vectors of GCC and Clang, so that one text serves SSE2, AVX2, AVX-512 and NEON.
 *
 * Every joint is a frame: rotation R to the world, origin o, and w, alpha, d in its own axes, d the
 * classical acceleration of the origin less gravity, in which linear velocity drops out. The last
 * joint of a body carries its parameters. Of the body regressor A (6, 10) in those axes the moments
 * and forces are turned into the world, once per link; a row is then u . force + z . moment, with
 * the axis z of the degree of freedom and the velocity u it gives to the link's origin. Origins
 * count from the tree's free joint, so a robot far from the world's origin loses no digits.
 */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#ifdef __x86_64__
#include <immintrin.h>
#endif

#include "../vectors.h"

#define TILE 3072 /* numbers of dense rows that are put together before they leave the caches */
#define LARGE (16 << 20) /* bytes of output that the caches do not hold */
#ifdef FEW /* for calls with few samples, which would else compute a whole block */
#define BLOCK LANES
#else
#define BLOCK 64 /* samples at once: a column is 512 bytes, the frames of an arm stay near */
#endif
#define STEPS (BLOCK / LANES)

typedef V S[STEPS]; /* one number of BLOCK samples */

#define EACH for (int k = 0; k < STEPS; k++)

enum { FREE, BALL, SLIDE, HINGE };                       /* MuJoCo's kinds of joints */
enum { ABOUT, ALONG, ABOUT_X, ABOUT_Y, ABOUT_Z, WORLD_X, WORLD_Y, WORLD_Z }; /* of a row */
enum { VELOCITY, SIGN, ONE, ACCELERATION, DEFLECTION };  /* joint terms */

/* Constants of a tree; `before` is the joint before (-1: the world), R0 p0 the pose in its frame
 * before the joint moves, with `axis` and `anchor` in the joint's own frame. */
typedef struct {
    int64_t joints, nq, nv;
    const int64_t *kind, *before, *qadr, *vadr;
    const double *R0, *p0, *axis, *anchor, *q0, *gravity;
} Tree;

/* Which columns of which links go where. Carrier c: the parameters at joint frame[c]; slot[c][10]
 * the output of each of the ten (-1: not wanted), or mix[c] (outputs[c], 10) from `mixes` where
 * mixed[c] >= 0. Its rows are pairs first[c] .. first[c + 1]: the motion `part` of joint `from`,
 * written to the values `dest` and following. */
typedef struct {
    int64_t carriers, terms, values;
    const int64_t *frame, *slot, *outputs, *mixed, *first, *from, *part, *dest;
    const double *mixes;
    const int64_t *term_kind, *term_dest, *term_vadr, *term_qadr;
    const double *term_reference;
} Plan;

typedef struct {
    int64_t samples;
    const double *q, *v, *a; /* (samples, nq), (samples, nv), (samples, nv) */
} Motion;

typedef struct {
    S R[9], o[3], w[3], alpha[3], d[3], z[3], p[3]; /* z, p: axis and a point of it, in the world */
} Frame;

/* Moments and forces of the ten parameters (an inertia gives no force, a mass no moment). */
typedef struct {
    S m[3], h_force[3][3], h_moment[3][3], I_moment[6][3];
} Columns;

/* --- Vectors of samples ------------------------------------------------------------------------ */

static inline V3 get(S *x, int k) { return (V3){x[0][k], x[1][k], x[2][k]}; }

static inline void put(S *x, int k, V3 y) { x[0][k] = y.x, x[1][k] = y.y, x[2][k] = y.z; }

static inline V dot(V3 a, V3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

/* Coordinate `place` of a (samples, width) array; the last sample fills what is left of a block. */
static inline void gather(S out, const double *x, int64_t width, int64_t place, int64_t n)
{
    double *o = (double *)out;
    x += place;
    for (int64_t k = 0; k < n; k++)
        o[k] = x[k * width];
    for (int64_t k = n; k < BLOCK; k++)
        o[k] = x[(n - 1) * width];
}

/* Sine and cosine; beyond a million, where the parts of pi/2 no longer suffice, the library's. */
static void sines_cosines(S x, S s, S c)
{
    I wild = {0};
    EACH {
        sine_cosine(x[k], &s[k], &c[k]);
        wild |= ~((x[k] < 1e6) & (x[k] > -1e6));
    }
    int64_t any = 0;
    for (int i = 0; i < LANES; i++)
        any |= wild[i];
    double *angle = (double *)x, *si = (double *)s, *co = (double *)c;
    for (int k = 0; any && k < BLOCK; k++)
        if (!(angle[k] < 1e6 && angle[k] > -1e6)) {
            si[k] = sin(angle[k]);
            co[k] = cos(angle[k]);
        }
}

/* --- Kinematics -------------------------------------------------------------------------------- */

/* Linear velocity in the world, angular velocity in the body; q is absolute. */
static void free_joint(Frame *f, const double *gravity, S q[7], S v[6], S a[6])
{
    EACH {
        V R[9];
        quaternion_matrix(R, q[3][k], q[4][k], q[5][k], q[6][k]);
        for (int i = 0; i < 9; i++)
            f->R[i][k] = R[i];
        put(f->o, k, all3((double[3]){0}));
        put(f->p, k, all3((double[3]){0}));
        put(f->w, k, get(v + 3, k));
        put(f->alpha, k, get(a + 3, k));
        put(f->d, k, turn_back(R, subtract(get(a, k), all3(gravity))));
    }
}

/* What a joint does to the frame before it, in constants: own rotation by_cosine cos q + by_sine
 * sin q + rest (a ball: rest Q), the place `at` where it acts, and `along` where a slide moves. */
typedef struct {
    double by_cosine[9], by_sine[9], rest[9], at[3], along[3];
} Step;

static Step step_of(const Tree *t, int64_t j)
{
    const double *a = t->axis + 3 * j, *anchor = t->anchor + 3 * j;
    const double skew[9] = {0, -a[2], a[1], a[2], 0, -a[0], -a[1], a[0], 0};
    const int kind = (int)t->kind[j];
    Step s = {0};
    for (int i = 0; i < 3; i++) {
        const double *row = t->R0 + 9 * j + 3 * i;
        double component = row[0] * a[0] + row[1] * a[1] + row[2] * a[2];
        s.at[i] = t->p0[3 * j + i];
        if (kind == SLIDE)
            s.along[i] = component;
        else
            s.at[i] += row[0] * anchor[0] + row[1] * anchor[1] + row[2] * anchor[2];
        for (int l = 0; l < 3; l++) {
            s.rest[3 * i + l] = kind == HINGE ? component * a[l] : row[l];
            s.by_cosine[3 * i + l] = kind == HINGE ? row[l] - component * a[l] : 0;
            s.by_sine[3 * i + l] = row[0] * skew[l] + row[1] * skew[3 + l] + row[2] * skew[6 + l];
        }
    }
    return s;
}

static inline void own_rotation(V *own, const Step *step, int kind, S q[7], V sine, V cosine, int k)
{
    V Q[9];
    if (kind == HINGE) {
        for (int i = 0; i < 9; i++)
            own[i] = cosine * step->by_cosine[i] + (sine * step->by_sine[i] + step->rest[i]);
    } else if (kind == BALL) {
        quaternion_matrix(Q, q[0][k], q[1][k], q[2][k], q[3][k]);
        for (int i = 0; i < 9; i += 3)
            for (int l = 0; l < 3; l++)
                own[i + l] = step->rest[i] * Q[l] + step->rest[i + 1] * Q[3 + l]
                           + step->rest[i + 2] * Q[6 + l];
    } else {
        for (int i = 0; i < 9; i++)
            own[i] = all(step->rest[i]);
    }
}

static inline __attribute__((always_inline)) void move(Frame *f, Frame *before, const Tree *t,
                                                       int64_t j, const int kind, S q[7], S v[6],
                                                       S a[6])
{
    const double *anchor = t->anchor + 3 * j;
    const int anchored = kind != SLIDE && (anchor[0] != 0 || anchor[1] != 0 || anchor[2] != 0);
    const Step step = step_of(t, j);
    const V3 axis = all3(t->axis + 3 * j), back = scaled(all3(anchor), all(-1));
    S sine, cosine;
    if (kind == HINGE)
        sines_cosines(q[0], sine, cosine);
    EACH {
        V base[9], own[9], R[9];
        V3 w = get(before->w, k), alpha = get(before->alpha, k), r = all3(step.at);
        for (int i = 0; i < 9; i++)
            base[i] = before->R[i][k];
        if (kind == SLIDE)
            r = add(r, scaled(all3(step.along), q[0][k]));
        V3 d = add(get(before->d, k), swing(w, alpha, r));
        V3 o = add(get(before->o, k), turn(base, r));
        own_rotation(own, &step, kind, q, sine[k], cosine[k], k);
        for (int i = 0; i < 9; i += 3)
            for (int l = 0; l < 3; l++)
                R[i + l] = base[i] * own[l] + base[i + 1] * own[3 + l] + base[i + 2] * own[6 + l];
        w = turn_back(own, w), alpha = turn_back(own, alpha), d = turn_back(own, d);
        V3 rate = kind == BALL ? get(v, k) : scaled(axis, v[0][k]);
        V3 change = kind == BALL ? get(a, k) : scaled(axis, a[0][k]), turning = cross(w, rate);
        if (kind == SLIDE) {
            d = add(d, add(change, scaled(turning, all(2))));
        } else {
            alpha = add(alpha, add(change, turning));
            w = add(w, rate);
            put(f->p, k, o);
            if (anchored) {
                d = add(d, swing(w, alpha, back));
                o = add(o, turn(R, back));
            }
        }
        if (kind != BALL)
            put(f->z, k, turn(R, axis));
        for (int i = 0; i < 9; i++)
            f->R[i][k] = R[i];
        put(f->w, k, w), put(f->alpha, k, alpha), put(f->d, k, d), put(f->o, k, o);
    }
}

/* The frames of all joints for n samples from `start` on; frames[-1] is the ground. */
static void sweep(const Tree *t, const Motion *m, int64_t start, int64_t n, Frame *frames)
{
    static const int coordinates[] = {7, 4, 1, 1}, dofs[] = {6, 3, 1, 1};
    S q[7], v[6], a[6];
    for (int64_t j = 0; j < t->joints; j++) {
        int kind = (int)t->kind[j];
        for (int i = 0; i < coordinates[kind]; i++)
            gather(q[i], m->q + start * t->nq, t->nq, t->qadr[j] + i, n);
        for (int i = 0; i < dofs[kind]; i++) {
            gather(v[i], m->v + start * t->nv, t->nv, t->vadr[j] + i, n);
            gather(a[i], m->a + start * t->nv, t->nv, t->vadr[j] + i, n);
        }
        if (kind == HINGE || kind == SLIDE)
            EACH q[0][k] -= t->q0[j];
        Frame *f = frames + j, *before = frames + t->before[j];
        if (kind == FREE)
            free_joint(f, t->gravity, q, v, a);
        else if (kind == HINGE)
            move(f, before, t, j, HINGE, q, v, a);
        else if (kind == SLIDE)
            move(f, before, t, j, SLIDE, q, v, a);
        else
            move(f, before, t, j, BALL, q, v, a);
    }
}

static void ground(const Tree *t, Frame *g)
{
    memset(g, 0, sizeof *g);
    for (int i = 0; i < 3; i++)
        EACH {
            g->R[4 * i][k] = 1.0 - (V){0};
            g->d[i][k] = -t->gravity[i] - (V){0};
        }
}

/* --- The body regressor ------------------------------------------------------------------------ */

/* The moments and forces of the ten, in the body's axes. */
typedef struct {
    V m[3], h_force[3][3], h_moment[3][3], I_moment[6][3];
} Entries;

static inline __attribute__((always_inline)) void entries(V3 w, V3 alpha, V3 d, Entries *A)
{
    const V wx = w.x, wy = w.y, wz = w.z, ax = alpha.x, ay = alpha.y, az = alpha.z;
    const V dx = d.x, dy = d.y, dz = d.z, zero = {0};
    /* as `python -m sysid_bench.regressors.symbolic_regressor c` prints them */
    A->m[0] = dx;
    A->m[1] = dy;
    A->m[2] = dz;
    A->h_moment[0][0] = zero;
    A->h_moment[0][1] = -dz;
    A->h_moment[0][2] = dy;
    A->h_force[0][0] = -wy*wy - wz*wz;
    A->h_force[0][1] = az + wx*wy;
    A->h_force[0][2] = -ay + wx*wz;
    A->h_moment[1][0] = dz;
    A->h_moment[1][1] = zero;
    A->h_moment[1][2] = -dx;
    A->h_force[1][0] = -az + wx*wy;
    A->h_force[1][1] = -wx*wx - wz*wz;
    A->h_force[1][2] = ax + wy*wz;
    A->h_moment[2][0] = -dy;
    A->h_moment[2][1] = dx;
    A->h_moment[2][2] = zero;
    A->h_force[2][0] = ay + wx*wz;
    A->h_force[2][1] = -ax + wy*wz;
    A->h_force[2][2] = -wx*wx - wy*wy;
    A->I_moment[0][0] = ax;
    A->I_moment[0][1] = wx*wz;
    A->I_moment[0][2] = -wx*wy;
    A->I_moment[1][0] = ay - wx*wz;
    A->I_moment[1][1] = ax + wy*wz;
    A->I_moment[1][2] = wx*wx - wy*wy;
    A->I_moment[2][0] = az + wx*wy;
    A->I_moment[2][1] = -wx*wx + wz*wz;
    A->I_moment[2][2] = ax - wy*wz;
    A->I_moment[3][0] = -wy*wz;
    A->I_moment[3][1] = ay;
    A->I_moment[3][2] = wx*wy;
    A->I_moment[4][0] = wy*wy - wz*wz;
    A->I_moment[4][1] = az - wx*wy;
    A->I_moment[4][2] = ay + wx*wz;
    A->I_moment[5][0] = wy*wz;
    A->I_moment[5][1] = -wx*wz;
    A->I_moment[5][2] = az;
    /* end */
}

static inline void put_turned(S *out, int k, const V *R, const V *x)
{
    put(out, k, turn(R, (V3){x[0], x[1], x[2]}));
}

static void world_columns(Frame *f, Columns *out)
{
    EACH {
        Entries A;
        V R[9];
        for (int i = 0; i < 9; i++)
            R[i] = f->R[i][k];
        entries(get(f->w, k), get(f->alpha, k), get(f->d, k), &A);
        put_turned(out->m, k, R, A.m);
        for (int c = 0; c < 3; c++) {
            put_turned(out->h_force[c], k, R, A.h_force[c]);
            put_turned(out->h_moment[c], k, R, A.h_moment[c]);
        }
        for (int c = 0; c < 6; c++)
            put_turned(out->I_moment[c], k, R, A.I_moment[c]);
    }
}

/* --- Rows -------------------------------------------------------------------------------------- */

/* A row about an axis z through the point p; y[10] are the columns of the ten. */
static inline void row_about(Frame *link, Columns *A, S *z, S *p, V *const y[10])
{
    EACH {
        V3 axis = get(z, k), u = cross(axis, subtract(get(link->o, k), get(p, k)));
        y[0][k] = dot(get(A->m, k), u);
        for (int c = 0; c < 3; c++)
            y[1 + c][k] = dot(get(A->h_force[c], k), u) + dot(get(A->h_moment[c], k), axis);
        for (int c = 0; c < 6; c++)
            y[4 + c][k] = dot(get(A->I_moment[c], k), axis);
    }
}

static inline void row_along(Columns *A, S *axis, V *const y[10])
{
    EACH {
        V3 u = get(axis, k);
        y[0][k] = dot(get(A->m, k), u);
        for (int c = 0; c < 3; c++)
            y[1 + c][k] = dot(get(A->h_force[c], k), u);
        for (int c = 4; c < 10; c++)
            y[c][k] = (V){0};
    }
}

static inline void row_of_world(Columns *A, int i, V *const y[10])
{
    EACH {
        y[0][k] = A->m[i][k];
        for (int c = 0; c < 3; c++)
            y[1 + c][k] = A->h_force[c][i][k];
        for (int c = 4; c < 10; c++)
            y[c][k] = (V){0};
    }
}

/* The axis of a row that turns, in the world. */
static inline void axis_of(S axis[3], Frame *from, int part)
{
    for (int i = 0; i < 3; i++)
        memcpy(axis[i], part == ABOUT ? from->z[i] : from->R[3 * i + part - ABOUT_X], sizeof(S));
}

static void row(Frame *link, Columns *A, Frame *from, int part, V *const y[10])
{
    S axis[3];
    if (part == ALONG) {
        row_along(A, from->z, y);
    } else if (part >= WORLD_X) {
        row_of_world(A, part - WORLD_X, y);
    } else {
        axis_of(axis, from, part);
        row_about(link, A, axis, from->p, y);
    }
}

static void mix(const double *weights, int64_t outputs, S raw[10], V *out)
{
    for (int64_t i = 0; i < outputs; i++, weights += 10) {
        V *y = out + i * STEPS;
        EACH {
            V sum = {0};
            for (int c = 0; c < 10; c++)
                if (weights[c] != 0)
                    sum += weights[c] * raw[c][k];
            y[k] = sum;
        }
    }
}

static inline double sign(double x) { return x > 0 ? 1.0 : x < 0 ? -1.0 : x; }

static void term(const Tree *t, const Plan *plan, int64_t i, const Motion *m, int64_t start,
                 int64_t n, S out)
{
    int kind = (int)plan->term_kind[i];
    double *x = (double *)out;
    if (kind == DEFLECTION)
        gather(out, m->q + start * t->nq, t->nq, plan->term_qadr[i], n);
    else
        gather(out, (kind == ACCELERATION ? m->a : m->v) + start * t->nv, t->nv,
               plan->term_vadr[i], n);
    for (int k = 0; k < BLOCK; k++)
        x[k] = kind == SIGN ? sign(x[k]) : kind == ONE ? 1.0 : x[k] - plan->term_reference[i];
}

typedef struct {
    Columns columns;
    S raw[10];
    S nowhere;
} Desk;

/* All rows of n samples from `start` on: values[i] is the column of BLOCK samples that row i of the
 * plan fills. */
static void fill(const Tree *t, const Plan *plan, const Motion *m, int64_t start, int64_t n,
                 Frame *frames, Desk *desk, V *values)
{
    sweep(t, m, start, n, frames);
    for (int64_t c = 0; c < plan->carriers; c++) {
        Frame *link = frames + plan->frame[c];
        world_columns(link, &desk->columns);
        for (int64_t i = plan->first[c]; i < plan->first[c + 1]; i++) {
            V *out = values + plan->dest[i] * STEPS, *y[10];
            const int mixed = plan->mixed[c] >= 0;
            for (int k = 0; k < 10; k++) {
                int64_t slot = plan->slot[10 * c + k];
                y[k] = mixed ? desk->raw[k] : slot < 0 ? desk->nowhere : out + slot * STEPS;
            }
            row(link, &desk->columns, frames + plan->from[i], (int)plan->part[i], y);
            if (mixed)
                mix(plan->mixes + plan->mixed[c], plan->outputs[c], desk->raw, out);
        }
    }
    for (int64_t i = 0; i < plan->terms; i++)
        term(t, plan, i, m, start, n, values + plan->term_dest[i] * STEPS);
}

/* --- Torque ------------------------------------------------------------------------------------ */

/* Force and moment (world) that move a link whose parameters are the ten numbers phi. */
static void wrench(Frame *f, const double *phi, S force[3], S moment[3])
{
    EACH {
        Entries A;
        V R[9], along[3], about[3];
        for (int i = 0; i < 9; i++)
            R[i] = f->R[i][k];
        entries(get(f->w, k), get(f->alpha, k), get(f->d, k), &A);
        for (int i = 0; i < 3; i++) {
            along[i] = phi[0] * A.m[i];
            about[i] = (V){0};
            for (int c = 0; c < 3; c++) {
                along[i] += phi[1 + c] * A.h_force[c][i];
                about[i] += phi[1 + c] * A.h_moment[c][i];
            }
            for (int c = 0; c < 6; c++)
                about[i] += phi[4 + c] * A.I_moment[c][i];
        }
        put_turned(force, k, R, along);
        put_turned(moment, k, R, about);
    }
}

static void add_torque(S tau, Frame *link, S force[3], S moment[3], Frame *from, int part)
{
    S z[3];
    if (part == ALONG) {
        EACH tau[k] += dot(get(from->z, k), get(force, k));
    } else if (part >= WORLD_X) {
        EACH tau[k] += force[part - WORLD_X][k];
    } else {
        axis_of(z, from, part);
        EACH {
            V3 arm = subtract(get(link->o, k), get(from->p, k));
            tau[k] += dot(get(z, k), add(get(moment, k), cross(arm, get(force, k))));
        }
    }
}

/* --- Dense output ------------------------------------------------------------------------------ */

/* Runs of neighbouring columns: `length` values from `value` on go to `column` of a row (value < 0:
 * zeros). Those of row r are first[r] .. first[r + 1]. */
typedef struct {
    int64_t rows, width;
    const int64_t *first, *value, *column, *length;
} Runs;

/* A run of LANES samples, `step` apart. */
static void lay(const V *x, int64_t length, double *y, int64_t step)
{
    const int64_t next = STEPS;
    int64_t c = 0;
    for (; c + LANES <= length; c += LANES)
        transpose(x + c * next, next, y + c, step);
    if (c < length && length >= LANES) /* once more what is there, and the rest */
        transpose(x + (length - LANES) * next, next, y + length - LANES, step);
    else
        for (; c < length; c++)
            for (int64_t k = 0; k < LANES; k++)
                y[k * step + c] = x[c * next][k];
}

/* Rows from .. to of LANES samples whose values stand at x, a sample every `step` of y. */
static void lay_rows(const Runs *runs, int64_t from, int64_t to, const V *x, double *y,
                     int64_t step)
{
    for (int64_t r = from; r < to; r++, y += runs->width)
        for (int64_t i = runs->first[r]; i < runs->first[r + 1]; i++) {
            double *at = y + runs->column[i];
            if (runs->value[i] >= 0)
                lay(x + runs->value[i] * STEPS, runs->length[i], at, step);
            else
                for (int64_t k = 0; k < LANES; k++)
                    memset(at + k * step, 0, 8 * runs->length[i]);
        }
}

/* All rows of one sample whose values stand in the first lane at x. */
static void lay_sample(const Runs *runs, const V *x, double *y)
{
    for (int64_t r = 0; r < runs->rows; r++, y += runs->width)
        for (int64_t i = runs->first[r]; i < runs->first[r + 1]; i++) {
            const int64_t value = runs->value[i];
            for (int64_t c = 0; c < runs->length[i]; c++)
                y[runs->column[i] + c] = value < 0 ? 0 : x[(value + c) * STEPS][0];
        }
}

/* A copy past the caches: what is larger than they are would only push out what is needed. */
static void stream(double *to, const double *from, int64_t count)
{
#ifdef __x86_64__
    for (; count > 0 && ((uintptr_t)to & 63); count--)
        *to++ = *from++;
    for (; count >= 8; count -= 8, to += 8, from += 8)
#if LANES == 8
        _mm512_stream_pd(to, _mm512_loadu_pd(from));
#elif LANES == 4
        for (int i = 0; i < 8; i += 4)
            _mm256_stream_pd(to + i, _mm256_loadu_pd(from + i));
#else
        for (int i = 0; i < 8; i += 2)
            _mm_stream_pd(to + i, _mm_loadu_pd(from + i));
#endif
#endif
    memcpy(to, from, 8 * count);
}

/* --- Folding ----------------------------------------------------------------------------------- */

static inline double sum(V x)
{
#if LANES == 8
    double __attribute__((vector_size(32))) low, high;
    memcpy(&low, &x, sizeof low);
    memcpy(&high, (double *)&x + 4, sizeof high);
    low += high;
#else
    V low = x;
#endif
#if LANES >= 4
    double __attribute__((vector_size(16))) first, second;
    memcpy(&first, &low, sizeof first);
    memcpy(&second, (double *)&low + 2, sizeof second);
    first += second;
#else
    V first = low;
#endif
    return first[0] + first[1];
}

/* The columns y[0 .. many) of [r; Y], less their part along the reflector (head, x). */
static inline __attribute__((always_inline)) void reflect(const V *restrict x, double head, double scale, double *restrict r,
                           V *restrict y, const int many)
{
    const int steps = STEPS;
    V dot[4] = {{0}, {0}, {0}, {0}};
    for (int k = 0; k < steps; k++)
        for (int i = 0; i < many; i++)
            dot[i] += x[k] * y[i * steps + k];
    double by[4];
    for (int i = 0; i < many; i++) {
        by[i] = (sum(dot[i]) + head * r[i]) * scale;
        r[i] -= by[i] * head;
    }
    for (int k = 0; k < steps; k++)
        for (int i = 0; i < many; i++)
            y[i * steps + k] -= by[i] * x[k];
}

/* R (m, m) of [R; X], X (BLOCK, m) column by column and destroyed: Householder's reflections, which
 * touch row j of R and the samples alone (LAPACK's tpqrt). */
static void absorb(int64_t m, double *restrict R, V *restrict X)
{
    const int steps = STEPS;
    for (int64_t j = 0; j < m; j++) {
        V *x = X + j * steps, squares = {0};
        for (int k = 0; k < steps; k++)
            squares += x[k] * x[k];
        double s = sum(squares), old = R[j * m + j];
        if (s < 1e-290) /* nothing there, or nothing that would not overflow below */
            continue;
        double new = -copysign(sqrt(old * old + s), old), head = old - new;
        double scale = -1.0 / (new * head);
        R[j * m + j] = new;
        int64_t l = j + 1;
        for (; l + 4 <= m; l += 4)
            reflect(x, head, scale, R + j * m + l, X + l * steps, 4);
        for (; l < m; l++)
            reflect(x, head, scale, R + j * m + l, X + l * steps, 1);
    }
}

/* --- What Python calls ------------------------------------------------------------------------- */

static int64_t least(int64_t a, int64_t b) { return a < b ? a : b; }

static char *aligned(void *work) { return (char *)(((uintptr_t)work + 63) & ~(uintptr_t)63); }

static int64_t rows_of_tile(int64_t width)
{
    int64_t rows = TILE / (LANES * (width + 1));
    return rows > 0 ? rows : 1;
}

/* Bytes of work that the functions below need; `width`: columns of a dense row. */
EXPORT int64_t LEVELLED(work)(const Tree *t, int64_t values, int64_t width)
{
    return 64 + (int64_t)sizeof(Frame) * (t->joints + 1) + (int64_t)sizeof(Desk)
         + (int64_t)sizeof(S) * values + 8 * LANES * width * rows_of_tile(width);
}

#define LAY_OUT                                                                                    \
    Frame *frames = (Frame *)aligned(work) + 1;                                                    \
    Desk *desk = (Desk *)(frames + t->joints);                                                     \
    ground(t, frames - 1)

/* values (plan->values, samples). */
EXPORT void LEVELLED(rows)(const Tree *t, const Plan *plan, const Motion *m, double *out,
                           void *work)
{
    LAY_OUT;
    V *values = (V *)(desk + 1);
    for (int64_t start = 0; start < m->samples; start += BLOCK) {
        int64_t n = least(BLOCK, m->samples - start);
        fill(t, plan, m, start, n, frames, desk, values);
        for (int64_t i = 0; i < plan->values; i++)
            memcpy(out + i * m->samples + start, values + i * STEPS, 8 * n);
    }
}

/* tau (samples, nv): the rigid-body torque of links with the ten numbers phi (carriers, 10), `dest`
 * of a pair its degree of freedom. */
EXPORT void LEVELLED(torque)(const Tree *t, const Plan *plan, const Motion *m, const double *phi,
                             double *tau, void *work)
{
    LAY_OUT;
    S *sums = (S *)(desk + 1), force[3], moment[3];
    for (int64_t start = 0; start < m->samples; start += BLOCK) {
        int64_t n = least(BLOCK, m->samples - start);
        sweep(t, m, start, n, frames);
        memset(sums, 0, sizeof(S) * t->nv);
        for (int64_t c = 0; c < plan->carriers; c++) {
            Frame *link = frames + plan->frame[c];
            wrench(link, phi + 10 * c, force, moment);
            for (int64_t i = plan->first[c]; i < plan->first[c + 1]; i++)
                add_torque(sums[plan->dest[i]], link, force, moment, frames + plan->from[i],
                           (int)plan->part[i]);
        }
        for (int64_t i = 0; i < t->nv; i++)
            for (int64_t k = 0; k < n; k++)
                tau[(start + k) * t->nv + i] = ((double *)sums[i])[k];
    }
}

/* Y (samples, rows, width) with its zeros. */
EXPORT void LEVELLED(dense)(const Tree *t, const Plan *plan, const Motion *m, const Runs *runs,
                            double *Y, void *work)
{
    LAY_OUT;
    V *values = (V *)(desk + 1);
    double *tile = (double *)(values + plan->values * STEPS);
    const int64_t rows = runs->rows, width = runs->width, size = rows * width;
    const int64_t chunk = rows_of_tile(width), large = m->samples * size * 8 >= LARGE;
    for (int64_t start = 0; start < m->samples; start += BLOCK) {
        int64_t n = least(BLOCK, m->samples - start);
        fill(t, plan, m, start, n, frames, desk, values);
        for (int64_t k = 0; k < n; k += LANES) {
            double *y = Y + (start + k) * size;
            const int64_t many = least(LANES, n - k);
            if (!large && many == LANES) {
                lay_rows(runs, 0, rows, values + k / LANES, y, size);
                continue;
            }
            if (many == 1) {
                lay_sample(runs, values + k / LANES, y);
                continue;
            }
            for (int64_t r = 0; r < rows; r += chunk) {
                int64_t end = least(r + chunk, rows), part = (end - r) * width;
                lay_rows(runs, r, end, values + k / LANES, tile, part);
                for (int64_t l = 0; l < many; l++)
                    stream(y + l * size + r * width, tile + l * part, part);
            }
        }
    }
}

/* Row r of `rows`: factor R[r] (size[r], size[r]) absorbs its columns, which are the values from
 * at[r] on, and b (samples, nv) of place[r], for which the plan leaves the value after them. */
EXPORT void LEVELLED(fold)(const Tree *t, const Plan *plan, const Motion *m, const double *b,
                           int64_t rows, const int64_t *at, const int64_t *size,
                           const int64_t *place, double *const *R, void *work)
{
    LAY_OUT;
    V *values = (V *)(desk + 1);
    for (int64_t start = 0; start < m->samples; start += BLOCK) {
        int64_t n = least(BLOCK, m->samples - start);
        fill(t, plan, m, start, n, frames, desk, values);
        for (int64_t r = 0; r < rows; r++) {
            V *X = values + at[r] * STEPS;
            double *last = (double *)(X + (size[r] - 1) * STEPS);
            for (int64_t k = 0; k < n; k++)
                last[k] = b[(start + k) * t->nv + place[r]];
            if (n < BLOCK)
                for (int64_t c = 0; c < size[r]; c++)
                    memset((double *)(X + c * STEPS) + n, 0, 8 * (BLOCK - n));
            absorb(size[r], R[r], X);
        }
    }
}

#ifdef SOURCE_HASH /* once in the library: of which text it was compiled, and what the machine runs */
EXPORT const char *kernel_source(void) { return TEXT(SOURCE_HASH); }
#endif
