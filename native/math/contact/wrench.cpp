#include "math/contact/wrench.h"
#include <limits>

namespace armlab {
namespace {

constexpr int newton_limit = 60;    // 14 were needed at most in 1e5 random problems
constexpr int clip_limit = 20000;   // the clip iteration needs thousands
constexpr double kkt_goal = 1e-10;  // clip stops here
constexpr double weakest = 1e-12;   // ls: smallest pivot of the scaled information
constexpr double rounding = 1e-14;  // map: a pivot below it, by the largest variance, has no digit

// P = scale S^-1 scale for the factor L of S (k, k).
void inverse(const double *L, int k, const double *scale, double *P) {
  for (int j = 0; j < k; ++j) {
    double column[6] = {};
    column[j] = 1.0;
    cholesky_solve(L, k, column);
    for (int i = 0; i < k; ++i) P[k * i + j] = scale[i] * scale[j] * column[i];
  }
  for (int i = 0; i < k; ++i)
    for (int j = 0; j < i; ++j) P[k * i + j] = P[k * j + i] = 0.5 * (P[k * i + j] + P[k * j + i]);
}

// x = K e with P = (I - K A^T) C_F (I - K A^T)^T + K C_tau K^T, positive for any gain K (k, n).
void joseph(const WrenchProblem &p, const double *K, double *x, double *P) {
  const int n = p.n, k = p.k;
  double B[36];
  for (int a = 0; a < k; ++a) {
    x[a] = 0.0;
    for (int i = 0; i < n; ++i) x[a] += K[n * a + i] * p.error[i];
    for (int b = 0; b < k; ++b) {
      double sum = a == b ? 1.0 : 0.0;
      for (int i = 0; i < n; ++i) sum -= K[n * a + i] * p.A[n * b + i];
      B[k * a + b] = sum;
    }
  }
  for (int a = 0; a < k; ++a)
    for (int b = 0; b <= a; ++b) {
      double sum = 0.0;
      for (int m = 0; m < k; ++m) sum += B[k * a + m] * p.prior[m] * B[k * b + m];
      for (int i = 0; i < n; ++i) sum += K[n * a + i] * p.variance[i] * K[n * b + i];
      P[k * a + b] = P[k * b + a] = sum;
    }
}

// K = C_F A S^-1, S = A^T C_F A + C_tau: needs no inverse of either covariance, and works at
// singular poses. False for numbers without a digit left.
bool map_gain(const WrenchProblem &p, double *K) {
  const int n = p.n, k = p.k;
  double S[max_joints * max_joints], largest = 0.0;
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j <= i; ++j) {
      double sum = i == j ? p.variance[i] : 0.0;
      for (int a = 0; a < k; ++a) sum += p.A[n * a + i] * p.prior[a] * p.A[n * a + j];
      S[n * i + j] = sum;
    }
    largest = std::max(largest, S[(n + 1) * i]);
  }
  if (!cholesky(S, n, rounding * largest)) return false;
  for (int a = 0; a < k; ++a) {
    double *row = K + n * a;
    for (int i = 0; i < n; ++i) row[i] = p.prior[a] * p.A[n * a + i];
    cholesky_solve(S, n, row);
  }
  return true;
}

// As TFRT-7651 prints it: (A C_tau A^T + C_F^-1)^-1 A C_tau e, right if C_tau is a weight.
bool printed_gain(const WrenchProblem &p, double *K) {
  const int n = p.n, k = p.k;
  double H[36];
  for (int a = 0; a < k; ++a)
    for (int b = 0; b <= a; ++b) {
      double sum = a == b ? 1.0 / p.prior[a] : 0.0;
      for (int i = 0; i < n; ++i) sum += p.A[n * a + i] * p.variance[i] * p.A[n * b + i];
      H[k * a + b] = sum;
    }
  if (!cholesky(H, k)) return false;
  for (int i = 0; i < n; ++i) {
    double column[6];
    for (int a = 0; a < k; ++a) column[a] = p.A[n * a + i] * p.variance[i];
    cholesky_solve(H, k, column);
    for (int a = 0; a < k; ++a) K[n * a + i] = column[a];
  }
  return true;
}

void undetermined(const WrenchProblem &p, WrenchSolution &s) {
  s.singular = true;
  std::fill_n(s.x, p.k, std::numeric_limits<double>::quiet_NaN());
  std::fill_n(s.P, p.k * p.k, std::numeric_limits<double>::quiet_NaN());
}

// (A C_tau^-1 A^T)^-1 A C_tau^-1 e; the unknowns are scaled by their prior only to judge the rank.
void least_squares(const WrenchProblem &p, WrenchSolution &s) {
  const int n = p.n, k = p.k;
  double H[36], scale[6], rhs[6];
  for (int a = 0; a < k; ++a) {
    double size = 0.0;
    for (int i = 0; i < n; ++i) size += p.A[n * a + i] * p.A[n * a + i] / p.variance[i];
    scale[a] = size > 0.0 ? 1.0 / std::sqrt(size) : 0.0;
  }
  for (int a = 0; a < k; ++a) {
    rhs[a] = 0.0;
    for (int i = 0; i < n; ++i) rhs[a] += scale[a] * p.A[n * a + i] * p.error[i] / p.variance[i];
    for (int b = 0; b <= a; ++b) {
      double sum = 0.0;
      for (int i = 0; i < n; ++i) sum += p.A[n * a + i] * p.A[n * b + i] / p.variance[i];
      H[k * a + b] = scale[a] * scale[b] * sum;
    }
  }
  if (!cholesky(H, k, weakest)) return undetermined(p, s);
  cholesky_solve(H, k, rhs);
  for (int a = 0; a < k; ++a) s.x[a] = scale[a] * rhs[a];
  inverse(H, k, scale, s.P);
}

// The cost sum_i max(|r_i| - bound_i, 0)^2 / variance_i + y^T y over unknowns y in units of the
// prior: convex, smooth, piecewise quadratic. `beyond` are the residuals less the bound.
struct BandCost {
  const WrenchProblem &p;
  double scale[6];
  double beyond[max_joints];

  explicit BandCost(const WrenchProblem &problem) : p(problem) {
    for (int a = 0; a < p.k; ++a) scale[a] = std::sqrt(p.prior[a]);
  }
  double operator()(const double *y) {
    double cost = 0.0;
    for (int i = 0; i < p.n; ++i) {
      double r = p.error[i];
      for (int a = 0; a < p.k; ++a) r -= p.A[p.n * a + i] * scale[a] * y[a];
      beyond[i] = std::copysign(std::max(std::fabs(r) - p.bound[i], 0.0), r);
      cost += beyond[i] * beyond[i] / p.variance[i];
    }
    for (int a = 0; a < p.k; ++a) cost += y[a] * y[a];
    return cost;
  }
  // Half the gradient at y, after the cost of y; returns its largest entry.
  double gradient(const double *y, double *g) const {
    double largest = 0.0;
    for (int a = 0; a < p.k; ++a) {
      g[a] = y[a];
      for (int i = 0; i < p.n; ++i) g[a] -= scale[a] * p.A[p.n * a + i] * beyond[i] / p.variance[i];
      largest = std::max(largest, std::fabs(g[a]));
    }
    return largest;
  }
  // Factor of half the Hessian: joints inside their band carry no information.
  bool hessian(double *H) const {
    for (int a = 0; a < p.k; ++a)
      for (int b = 0; b <= a; ++b) {
        double sum = a == b ? 1.0 : 0.0;
        for (int i = 0; i < p.n; ++i)
          if (beyond[i] != 0.0)
            sum += scale[a] * scale[b] * p.A[p.n * a + i] * p.A[p.n * b + i] / p.variance[i];
        H[p.k * a + b] = sum;
      }
    return cholesky(H, p.k);
  }
};

void finish(const BandCost &cost, const double *y, WrenchSolution &s) {
  const int k = cost.p.k;
  double H[36], g[6];
  s.kkt = cost.gradient(y, g);
  if (!cost.hessian(H) || !std::all_of(g, g + k, [](double x) { return std::isfinite(x); }))
    return undetermined(cost.p, s);
  inverse(H, k, cost.scale, s.P);
  for (int a = 0; a < k; ++a) s.x[a] = cost.scale[a] * y[a];
  for (int i = 0; i < cost.p.n; ++i) s.active[i] = cost.beyond[i] != 0.0;
}

// Semismooth Newton with step halving; exact once no joint changes its side of the band.
void newton(const WrenchProblem &p, WrenchSolution &s) {
  const int k = p.k;
  BandCost cost(p);
  double y[6] = {}, value = cost(y);
  for (s.iterations = 0; s.iterations < newton_limit; ++s.iterations) {
    double g[6], step[6], H[36], trial[6];
    if (cost.gradient(y, g) == 0.0) break;
    if (!cost.hessian(H)) break;
    std::copy_n(g, k, step);
    cholesky_solve(H, k, step);
    double slope = 0.0, size = 0.0, length = 1.0, next = value;
    for (int a = 0; a < k; ++a) {
      slope -= 2.0 * g[a] * step[a];
      size = std::max(size, std::fabs(step[a]));
    }
    for (int halving = 0; halving < 40; ++halving, length *= 0.5) {
      for (int a = 0; a < k; ++a) trial[a] = y[a] - length * step[a];
      next = cost(trial);
      if (next <= value + 1e-4 * length * slope) break;
    }
    if (!(next < value)) {  // nothing more to gain in double precision
      value = cost(y);
      break;
    }
    std::copy_n(trial, k, y);
    value = next;
    if (length * size < 1e-13) break;
  }
  finish(cost, y, s);
}

// d <- clip(e - A^T x, -bound, bound); x <- MAP(e - d). Monotone and slow.
void clip(const WrenchProblem &p, WrenchSolution &s) {
  const int n = p.n, k = p.k;
  double K[6 * max_joints], y[6] = {}, g[6];
  if (!map_gain(p, K)) return undetermined(p, s);
  BandCost cost(p);
  for (s.iterations = 0; s.iterations < clip_limit; ++s.iterations) {
    cost(y);
    if (!(cost.gradient(y, g) >= kkt_goal)) break;
    double x[6] = {}, free[max_joints];
    for (int i = 0; i < n; ++i) {
      double along = 0.0;
      for (int a = 0; a < k; ++a) along += p.A[n * a + i] * cost.scale[a] * y[a];
      free[i] = along + cost.beyond[i];
    }
    for (int a = 0; a < k; ++a) {
      for (int i = 0; i < n; ++i) x[a] += K[n * a + i] * free[i];
      y[a] = x[a] / cost.scale[a];
    }
  }
  cost(y);
  finish(cost, y, s);
}

}  // namespace

void solve_wrench(const WrenchProblem &p, WrenchMethod method, WrenchSolution &s) {
  std::fill_n(s.active, p.n, true);
  s.iterations = 0;
  s.kkt = 0.0;
  s.singular = false;
  double K[6 * max_joints];
  if (method == WrenchMethod::map || method == WrenchMethod::lund) {
    const bool found = method == WrenchMethod::map ? map_gain(p, K) : printed_gain(p, K);
    return found ? joseph(p, K, s.x, s.P) : undetermined(p, s);
  }
  if (method == WrenchMethod::ls) return least_squares(p, s);
  if (method == WrenchMethod::clip) return clip(p, s);
  newton(p, s);
}

}  // namespace armlab
