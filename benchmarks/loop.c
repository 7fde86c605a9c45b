/* The loop of tdof_npid_ros/loop.py in C: a linear plant with dead time under the TDOF-NPID law.

   Compiled for each number of plant states (-DORDER) and of lanes (-DLANES), as Numba compiles ours; gains, plant and
   signals are arguments in both. -DPOLYNOMIAL takes the exponential of tdof_npid_ros/control/exponential.py in place of
   the C library's.

   Standard input: steps, runs, steps until the setpoint goes from 1 to 0 and back, delay in samples, phi, gamma_old, gamma_new, eight coefficients of the law, five limits,
   two limits of the plant. The lanes differ in kp. Prints the best run's steps per second, then the first lane's sum
   of absolute errors and its largest. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

typedef struct { double phi[ORDER][ORDER], gamma_old[ORDER], gamma_new[ORDER]; } plant;
typedef struct { double kp[LANES], ki_h[LANES], kd_h[LANES], phi[LANES], alpha[LANES], beta[LANES], q[LANES], tracking[LANES]; } law;
typedef struct { double u_min, u_max, i_min, i_max, conditional, low, high; } limits;
typedef struct { double x[ORDER][LANES], u_i[LANES], z[LANES], sum[LANES], sound[LANES], largest[LANES]; } state;

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

static inline double exp_minus(double q) {
#ifdef POLYNOMIAL
    q = q < 700.0 ? q : 700.0;
    double shifted = fma(q, -1.4426950408889634, 6755399441055744.0), n = shifted - 6755399441055744.0;
    double f = fma(n, -1.90821492927058770002e-10, fma(n, -0.693147180369123816490, -q)), f2 = f * f, f4 = f2 * f2;
    double low = fma(f2, fma(f, 0.16666666666666413, 0.5000000000000011), 1 + f);
    double middle = fma(f2, fma(f, 0.000198412695067425, 0.0013888888943603685),
                        fma(f, 0.008333333333494357, 0.041666666666530246));
    double high = fma(f2, fma(f, 2.500007031530457e-08, 2.7630236589949976e-07),
                      fma(f, 2.755758628627501e-06, 2.4801493129301335e-05));
    double mantissa = fma(f4, fma(f4, high, middle), low);
    unsigned long bits, exponent;
    memcpy(&bits, &mantissa, 8);
    memcpy(&exponent, &shifted, 8);
    bits += exponent << 52;
    memcpy(&mantissa, &bits, 8);
    return mantissa;
#else
    return exp(-q);
#endif
}

/* min and max as comparisons, which the compiler turns into one instruction each; fmin and fmax must mind NaN. */
static inline double clamp(double v, double low, double high) {
    v = v > low ? v : low;
    return v < high ? v : high;
}

__attribute__((noinline)) static state run(long steps, long delay, plant p, const law *restrict c, limits m,
                                           double (*restrict line)[LANES], const double *restrict setpoint,
                                           const double *restrict disturbance, const double *restrict weight) {
    state s = {0};
    long size = delay + 2, slot = 0;
    for (long k = 0; k <= steps; k++) {
        double r = setpoint[k], d = disturbance[k];
        long oldest = slot + 1 == size ? 0 : slot + 1, due = oldest + 1 == size ? 0 : oldest + 1;
        for (int j = 0; j < LANES; j++) {
            double y = s.x[0][j], e = r - y, zeta = exp_minus(e * e * c->q[j]) * e;
            double e_d = (1 - c->beta[j]) * r - y;
            double raw = c->kp[j] * ((1 - c->alpha[j]) * r - y) + s.u_i[j] + c->kd_h[j] * (e_d - s.z[j]);
            double u = clamp(raw, m.u_min, m.u_max), step = c->ki_h[j] * zeta;
            double held = m.conditional * (raw - u) * step > 0 ? 0 : step;
            step = u != raw ? held + c->tracking[j] * (u - raw) : step;
            s.u_i[j] = clamp(s.u_i[j] + step, m.i_min, m.i_max);
            s.z[j] = e_d + c->phi[j] * (s.z[j] - e_d);
            double v = clamp(u, m.low, m.high) + d, v_old = line[oldest][j], v_new = delay == 0 ? v : line[due][j];
            line[slot][j] = v;
            double moved[ORDER];
            for (int i = 0; i < ORDER; i++) {
                moved[i] = p.gamma_old[i] * v_old + p.gamma_new[i] * v_new;
                for (int l = 0; l < ORDER; l++) moved[i] += p.phi[i][l] * s.x[l][j];
            }
            int bounded = fabs(moved[0]) < 1e100;
            for (int i = 0; i < ORDER; i++) s.x[i][j] = bounded ? moved[i] : s.x[i][j];
            s.sum[j] += weight[k] * fabs(e);
            s.sound[j] += fabs(y) < 1e12 ? 1.0 : 0.0;
            s.largest[j] = fabs(e) > s.largest[j] ? fabs(e) : s.largest[j];
        }
        slot = oldest;
    }
    return s;
}

static double number(void) {
    double value;
    if (scanf("%lf", &value) != 1) exit(2);
    return value;
}

int main(void) {
    long steps = number(), runs = number(), every = number(), delay = number();
    plant p;
    law c;
    limits m;
    for (int i = 0; i < ORDER * ORDER; i++) p.phi[i / ORDER][i % ORDER] = number();
    for (int i = 0; i < ORDER; i++) p.gamma_old[i] = number();
    for (int i = 0; i < ORDER; i++) p.gamma_new[i] = number();
    for (int i = 0; i < 8; i++) {
        double value = number();
        for (int j = 0; j < LANES; j++) ((double *)&c)[i * LANES + j] = value;
    }
    for (int j = 1; j < LANES; j++) c.kp[j] *= 1 - 0.1 * j / LANES;
    for (int i = 0; i < 7; i++) ((double *)&m)[i] = number();
    double *r = malloc((steps + 1) * sizeof *r), *d = calloc(steps + 1, sizeof *d), *w = malloc((steps + 1) * sizeof *w);
    double(*line)[LANES] = malloc((delay + 2) * sizeof *line), best = 1e9, sum = 0, largest = 0;
    for (long k = 0; k <= steps; k++) r[k] = 1 - (k - (k == steps)) / every % 2, w[k] = k == 0 || k == steps ? 0.5 : 1.0;
    for (int i = 0; i < runs; i++) {
        memset(line, 0, (delay + 2) * sizeof *line);
        double start = now();
        state end = run(steps, delay, p, &c, m, line, r, d, w);
        double taken = now() - start;
        sum = end.sum[0], largest = end.largest[0];
        best = taken < best ? taken : best;
    }
    printf("%.1f %.17g %.17g\n", LANES * (steps + 1) / best, sum, largest);
    return 0;
}
