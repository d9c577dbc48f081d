/* Vectors of the C files: numbers in lanes, one text for SSE2, AVX2, AVX-512 and NEON, compiled once
 * per instruction set (LEVEL), with the names of functions that are called from Python.
 *
 * Vectors of GCC and Clang. A library states the hash of its source and of this text; the object
 * that defines SOURCE_HASH also tells what the machine runs. */

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

static inline V all(double x) { return x - (V){0}; }

static inline V3 all3(const double *x) { return (V3){all(x[0]), all(x[1]), all(x[2])}; }

static inline V3 add(V3 a, V3 b) { return (V3){a.x + b.x, a.y + b.y, a.z + b.z}; }

static inline V3 subtract(V3 a, V3 b) { return (V3){a.x - b.x, a.y - b.y, a.z - b.z}; }

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

/* Acceleration of the point r of a body against that of its origin. */
static inline V3 swing(V3 w, V3 alpha, V3 r)
{
    return add(cross(alpha, r), cross(w, cross(w, r)));
}

/* Sine and cosine: reduction by pi/2 in three parts and the polynomials of fdlibm, below one unit in
 * the last place up to a million radians; further angles need the library. */
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

static inline void quaternion_matrix(V *R, V w, V x, V y, V z)
{
    V two = 2.0 / (w * w + x * x + y * y + z * z);
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

#if defined(__clang__) || __GNUC__ >= 12
#define PICK(x, y, ...) __builtin_shufflevector(x, y, __VA_ARGS__)
#else
#define PICK(x, y, ...) __builtin_shuffle(x, y, (I){__VA_ARGS__})
#endif

/* LANES numbers in lanes, `next` vectors apart, become LANES rows of numbers, `step` apart. */
static inline void transpose(const V *x, int64_t next, double *y, int64_t step)
{
    V a[LANES];
#if LANES == 8
    V b[LANES];
    for (int i = 0; i < 8; i += 2) {
        a[i] = PICK(x[i * next], x[(i + 1) * next], 0, 8, 2, 10, 4, 12, 6, 14);
        a[i + 1] = PICK(x[i * next], x[(i + 1) * next], 1, 9, 3, 11, 5, 13, 7, 15);
    }
    for (int i = 0; i < 8; i += 4)
        for (int l = i; l < i + 2; l++) {
            b[l] = PICK(a[l], a[l + 2], 0, 1, 8, 9, 4, 5, 12, 13);
            b[l + 2] = PICK(a[l], a[l + 2], 2, 3, 10, 11, 6, 7, 14, 15);
        }
    for (int l = 0; l < 4; l++) {
        a[l] = PICK(b[l], b[l + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        a[l + 4] = PICK(b[l], b[l + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
#elif LANES == 4
    for (int i = 0; i < 4; i += 2) {
        a[i] = PICK(x[i * next], x[(i + 1) * next], 0, 4, 2, 6);
        a[i + 1] = PICK(x[i * next], x[(i + 1) * next], 1, 5, 3, 7);
    }
    for (int l = 0; l < 2; l++) {
        V low = PICK(a[l], a[l + 2], 0, 1, 4, 5), high = PICK(a[l], a[l + 2], 2, 3, 6, 7);
        a[l] = low, a[l + 2] = high;
    }
#else
    a[0] = PICK(x[0], x[next], 0, 2);
    a[1] = PICK(x[0], x[next], 1, 3);
#endif
    for (int l = 0; l < LANES; l++)
        memcpy(y + l * step, &a[l], sizeof(V));
}

#ifdef SOURCE_HASH /* once in a library */
#define TEXT_(x) #x
#define TEXT(x) TEXT_(x)
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
