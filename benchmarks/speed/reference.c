/* Textbook C for the same work, compiled where it runs: gcc -O3 -march=native, sizes known to the compiler. */
#include <math.h>
#include <string.h>

#ifndef M
#define M 5
#endif
#define P (1 + M + M * (M + 1) / 2)
#define LANES 100

/* Second-order Volterra LMS, step size per degree; errors out, weights in and out. */
void lms(const double *restrict u, const double *restrict y, const double *mu, double *restrict e,
         double *restrict w, long N) {
  double x[M] = {0}, phi[P], step[P];
  for (int i = 0; i < P; i++) step[i] = i == 0 ? mu[0] : i <= M ? mu[1] : mu[2];
  for (long n = 0; n < N; n++) {
    for (int i = M - 1; i > 0; i--) x[i] = x[i - 1];
    x[0] = u[n];
    phi[0] = 1.0;
    for (int i = 0; i < M; i++) phi[1 + i] = x[i];
    int k = 1 + M;
    for (int i = 0; i < M; i++)
      for (int j = i; j < M; j++) phi[k++] = x[i] * x[j];
    double sum = 0;
    for (int i = 0; i < P; i++) sum += w[i] * phi[i];
    const double err = y[n] - sum;
    e[n] = err;
    for (int i = 0; i < P; i++) w[i] += step[i] * err * phi[i];
  }
}

/* The same for LANES sets of step sizes at once, lanes innermost so that they vectorise; sums of squares out. */
void lms_lanes(const double *restrict u, const double *restrict y, const double *restrict mu,
               double *restrict sse, double *restrict w, long N) {
  double x[M] = {0}, phi[P];
  for (long n = 0; n < N; n++) {
    for (int i = M - 1; i > 0; i--) x[i] = x[i - 1];
    x[0] = u[n];
    phi[0] = 1.0;
    for (int i = 0; i < M; i++) phi[1 + i] = x[i];
    int k = 1 + M;
    for (int i = 0; i < M; i++)
      for (int j = i; j < M; j++) phi[k++] = x[i] * x[j];
    double err[LANES];
    for (int c = 0; c < LANES; c++) err[c] = y[n];
    for (int i = 0; i < P; i++)
      for (int c = 0; c < LANES; c++) err[c] -= w[i * LANES + c] * phi[i];
    for (int c = 0; c < LANES; c++) sse[c] += err[c] * err[c];
    for (int i = 0; i < P; i++) {
      const double *m = mu + (i == 0 ? 0 : i <= M ? 1 : 2) * LANES;
      for (int c = 0; c < LANES; c++) w[i * LANES + c] += m[c] * err[c] * phi[i];
    }
  }
}

/* Recursive least squares on the same regressors, inverse Gram matrix R in and out. */
void rls(const double *restrict u, const double *restrict y, double lam, double *restrict e,
         double *restrict w, double *restrict R, long N) {
  double x[M] = {0}, phi[P], g[P];
  for (long n = 0; n < N; n++) {
    for (int i = M - 1; i > 0; i--) x[i] = x[i - 1];
    x[0] = u[n];
    phi[0] = 1.0;
    for (int i = 0; i < M; i++) phi[1 + i] = x[i];
    int k = 1 + M;
    for (int i = 0; i < M; i++)
      for (int j = i; j < M; j++) phi[k++] = x[i] * x[j];
    memset(g, 0, sizeof g);
    for (int j = 0; j < P; j++)
      for (int i = 0; i < P; i++) g[i] += R[j * P + i] * phi[j];
    double a = lam, sum = 0;
    for (int i = 0; i < P; i++) a += g[i] * phi[i];
    for (int i = 0; i < P; i++) sum += w[i] * phi[i];
    const double err = y[n] - sum;
    e[n] = err;
    for (int i = 0; i < P; i++) w[i] += g[i] * (err / a);
    for (int j = 0; j < P; j++) {
      const double share = g[j] / a;
      for (int i = 0; i < P; i++) R[j * P + i] = (R[j * P + i] - share * g[i]) * (1 / lam);
    }
  }
}

/* Flexible joint without current: theta, alpha, and their speeds; friction level tanh(speed / width), cubic
   spring. p: hub inertia, arm inertia, stiffness, motor gain [N m/V], motor damping, hub damping, joint damping,
   cubic stiffness, friction level, width of its tanh. */
static inline void flow(const double *x, double v, const double *p, double *d) {
  const double spring = p[2] * x[1] + p[7] * x[1] * x[1] * x[1] + p[6] * x[3];
  const double hub = p[3] * v - (p[4] + p[5]) * x[2] - p[8] * tanh(x[2] / p[9]);
  d[0] = x[2];
  d[1] = x[3];
  d[2] = (hub + spring) / p[0];
  d[3] = -spring / p[1] - d[2];
}

void joint(const double *restrict u, const double *p, double h, int substeps, double *restrict out, long N) {
  double x[4] = {0}, a[4], b[4], c[4], d[4], s[4];
  h /= substeps;
  for (long n = 0; n < N; n++) {
    out[2 * n] = x[0];
    out[2 * n + 1] = x[1];
    for (int m = 0; m < substeps; m++) {
      flow(x, u[n], p, a);
      for (int i = 0; i < 4; i++) s[i] = x[i] + h / 2 * a[i];
      flow(s, u[n], p, b);
      for (int i = 0; i < 4; i++) s[i] = x[i] + h / 2 * b[i];
      flow(s, u[n], p, c);
      for (int i = 0; i < 4; i++) s[i] = x[i] + h * c[i];
      flow(s, u[n], p, d);
      for (int i = 0; i < 4; i++) x[i] += h / 6 * (a[i] + 2 * b[i] + 2 * c[i] + d[i]);
    }
  }
}

/* The same with the motor's current as a fifth state. m: torque per current and voltage per speed at the hub,
   resistance, inductance; p[3] and p[4] are not used. */
static inline void flow_current(const double *x, double v, const double *p, const double *m, double *d) {
  const double spring = p[2] * x[1] + p[7] * x[1] * x[1] * x[1] + p[6] * x[3];
  const double hub = m[0] * x[4] - p[5] * x[2] - p[8] * tanh(x[2] / p[9]);
  d[0] = x[2];
  d[1] = x[3];
  d[2] = (hub + spring) / p[0];
  d[3] = -spring / p[1] - d[2];
  d[4] = (v - m[2] * x[4] - m[1] * x[2]) / m[3];
}

void joint_current(const double *restrict u, const double *p, const double *m, double h, int substeps,
                   double *restrict out, long N) {
  double x[5] = {0}, a[5], b[5], c[5], d[5], s[5];
  h /= substeps;
  for (long n = 0; n < N; n++) {
    out[2 * n] = x[0];
    out[2 * n + 1] = x[1];
    for (int k = 0; k < substeps; k++) {
      flow_current(x, u[n], p, m, a);
      for (int i = 0; i < 5; i++) s[i] = x[i] + h / 2 * a[i];
      flow_current(s, u[n], p, m, b);
      for (int i = 0; i < 5; i++) s[i] = x[i] + h / 2 * b[i];
      flow_current(s, u[n], p, m, c);
      for (int i = 0; i < 5; i++) s[i] = x[i] + h * c[i];
      flow_current(s, u[n], p, m, d);
      for (int i = 0; i < 5; i++) x[i] += h / 6 * (a[i] + 2 * b[i] + 2 * c[i] + d[i]);
    }
  }
}
