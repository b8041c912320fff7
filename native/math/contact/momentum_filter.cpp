#include "math/contact/momentum_estimator.h"

namespace armlab {

namespace {

// (1 - 2 phi / h + zz / h) / x^2 up to x = 1, where this form loses digits: the sum of (2^(k+2) -
// 2) (-x)^k / (k+3)!.
double series(double x) {
  double sum = 0.0, term = 1.0 / 6.0, power = 4.0;
  for (int k = 0; k < 20 && std::fabs(term) > 1e-24; ++k, power *= 2.0) {
    sum += term * (power - 2.0);
    term *= -x / (k + 4);
  }
  return sum;
}

}  // namespace

Leak leak_integrals(double a, double h) {
  const double x = a * h;
  if (!(x > 0.0)) return {1.0, h, h, 0.5 * h * h, h * h * h / 3.0};
  const double phi = -std::expm1(-x) / a, zz = -std::expm1(-2.0 * x) / (2.0 * a);
  const double pp = x > 1.0 ? (h - 2.0 * phi + zz) / (a * a) : h * h * h * series(x);
  return {std::exp(-x), phi, zz, 0.5 * phi * phi, pp};
}

namespace {

// C (rows, columns) = A (rows, inner) B (inner, columns); strides are lengths of rows.
void multiply(int rows, int inner, int columns, const double *A, int sa, const double *B, int sb,
    double *C, int sc) {
  for (int i = 0; i < rows; ++i) {
    double *c = C + sc * i;
    std::fill_n(c, columns, 0.0);
    for (int k = 0; k < inner; ++k) {
      const double f = A[sa * i + k];
      const double *b = B + sb * k;
      for (int j = 0; j < columns; ++j) c[j] += f * b[j];
    }
  }
}

// P <- Phi P Phi^T + Q. Only the first n rows and columns of Phi couple, through W = G diag(phi).
void predict(const MomentumInputs &in, double h, double *x, double *P, double *W, double *T) {
  const int n = in.n, m = in.m, N = n + m;
  Leak leak[max_inputs];
  for (int j = 0; j < m; ++j) leak[j] = leak_integrals(in.a[j], h);
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < m; ++j) W[m * i + j] = in.G[m * i + j] * leak[j].phi;
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < m; ++j) x[i] += W[m * i + j] * x[n + j];
  for (int j = 0; j < m; ++j) x[n + j] *= leak[j].decay;
  // Rows p of Phi P: those of P plus W times rows z.
  multiply(n, m, N, W, m, P + N * n, N, T, N);
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < N; ++j) P[N * i + j] += T[N * i + j];
  // Columns p of (Phi P) Phi^T, rows p only; the rest follows from symmetry.
  for (int i = 0; i < n; ++i)
    for (int k = 0; k <= i; ++k) {
      double sum = P[N * i + k] + (i == k ? in.Qp[i] * h : 0.0);
      for (int j = 0; j < m; ++j)
        sum += P[N * i + n + j] * W[m * k + j] +
               in.G[m * i + j] * in.q[j] * leak[j].pp * in.G[m * k + j];
      T[N * i + k] = T[N * k + i] = sum;
    }
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j < m; ++j)
      P[N * (n + j) + i] = P[N * i + n + j] =
          P[N * i + n + j] * leak[j].decay + in.G[m * i + j] * in.q[j] * leak[j].pz;
    std::copy_n(T + N * i, n, P + N * i);
  }
  for (int i = 0; i < m; ++i)
    for (int j = 0; j < m; ++j)
      P[N * (n + i) + n + j] = leak[i].decay * P[N * (n + i) + n + j] * leak[j].decay +
                               (i == j ? in.q[i] * leak[i].zz : 0.0);
}

}  // namespace

bool momentum_step(const MomentumInputs &in, const double *u, const double *y, const double *R,
    double h, double *x_, double *P_, double *work) {
  const int n = in.n, N = in.n + in.m;
  double *P = work, *K = work + N * N, *T = work + 2 * N * N, *W = work + 3 * N * N;
  double x[max_states], S[max_joints * max_joints], innovation[max_joints];
  std::copy_n(x_, N, x);
  std::copy_n(P_, N * N, P);
  predict(in, h, x, P, W, T);
  for (int i = 0; i < n; ++i) {
    x[i] += h * u[i];
    innovation[i] = y[i] - x[i];
    for (int j = 0; j < n; ++j) S[n * i + j] = P[N * i + j] + R[n * i + j];
  }
  if (!cholesky(S, n)) return false;
  for (int i = 0; i < N; ++i) {  // rows of K = P[:, :n] S^-1
    std::copy_n(P + N * i, n, K + n * i);
    cholesky_solve(S, n, K + n * i);
    for (int k = 0; k < n; ++k) x[i] += K[n * i + k] * innovation[k];
  }
  // Joseph: A P A^T + K R K^T with A = I - K [I 0]; first T = A P, then P = T A^T.
  multiply(N, n, N, K, n, P, N, T, N);
  for (int i = 0; i < N * N; ++i) T[i] = P[i] - T[i];
  double *KR = W;
  multiply(N, n, n, K, n, R, n, KR, n);
  for (int i = 0; i < N; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = T[N * i + j], other = T[N * j + i];
      for (int k = 0; k < n; ++k) {
        sum += KR[n * i + k] * K[n * j + k] - T[N * i + k] * K[n * j + k];
        other += KR[n * j + k] * K[n * i + k] - T[N * j + k] * K[n * i + k];
      }
      P_[N * i + j] = P_[N * j + i] = 0.5 * (sum + other);
    }
  std::copy_n(x, N, x_);
  return true;
}

}  // namespace armlab
