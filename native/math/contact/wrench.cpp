#include "math/contact/wrench.h"
#include <limits>

namespace armlab {
namespace {

constexpr int newton_limit = 60;    // 1e5 random problems needed at most 14
constexpr int clip_limit = 20000;   // the clip iteration needs thousands
constexpr double kkt_goal = 1e-10;  // clip stops here
constexpr double weakest = 1e-12;   // ls, ols: smallest pivot of the scaled information
constexpr double rounding = 1e-14;  // map: smallest pivot with significant digits, relative

// P = scale S^-1 scale for the S (k, k) factorised by `factor`.
void inverse(const double *L, int k, const double *scale, double *P) {
  for (int j = 0; j < k; ++j) {
    double column[6] = {};
    column[j] = 1.0;
    substitute(L, k, column);
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

// K = C_F A S^-1, S = A^T C_F A + C_tau: inverts neither covariance and is defined at singular
// poses. False if no significant digits are left.
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
  if (!factor(S, n, rounding * largest)) return false;
  for (int a = 0; a < k; ++a) {
    double *row = K + n * a;
    for (int i = 0; i < n; ++i) row[i] = p.prior[a] * p.A[n * a + i];
    substitute(S, n, row);
  }
  return true;
}

// As printed in TFRT-7651, (A C_tau A^T + C_F^-1)^-1 A C_tau e; correct if C_tau is a weight.
bool printed_gain(const WrenchProblem &p, double *K) {
  const int n = p.n, k = p.k;
  double H[36];
  for (int a = 0; a < k; ++a)
    for (int b = 0; b <= a; ++b) {
      double sum = a == b ? 1.0 / p.prior[a] : 0.0;
      for (int i = 0; i < n; ++i) sum += p.A[n * a + i] * p.variance[i] * p.A[n * b + i];
      H[k * a + b] = sum;
    }
  if (!factor(H, k)) return false;
  for (int i = 0; i < n; ++i) {
    double column[6];
    for (int a = 0; a < k; ++a) column[a] = p.A[n * a + i] * p.variance[i];
    substitute(H, k, column);
    for (int a = 0; a < k; ++a) K[n * a + i] = column[a];
  }
  return true;
}

void undetermined(const WrenchProblem &p, WrenchSolution &s) {
  s.singular = true;
  std::fill_n(s.x, p.k, std::numeric_limits<double>::quiet_NaN());
  std::fill_n(s.P, p.k * p.k, std::numeric_limits<double>::quiet_NaN());
}

// K = (A W A^T)^-1 A W with weights W = C_tau^-1 for ls and 1 for ols. The unknowns are scaled only
// to determine the rank. False if the unknowns are not identifiable.
bool least_squares_gain(const WrenchProblem &p, bool weighted, double *K) {
  const int n = p.n, k = p.k;
  double H[36], scale[6], weight[max_joints];
  for (int i = 0; i < n; ++i) weight[i] = weighted ? 1.0 / p.variance[i] : 1.0;
  for (int a = 0; a < k; ++a) {
    double size = 0.0;
    for (int i = 0; i < n; ++i) size += p.A[n * a + i] * p.A[n * a + i] * weight[i];
    scale[a] = size > 0.0 ? 1.0 / std::sqrt(size) : 0.0;
    for (int b = 0; b <= a; ++b) {
      double sum = 0.0;
      for (int i = 0; i < n; ++i) sum += p.A[n * a + i] * p.A[n * b + i] * weight[i];
      H[k * a + b] = scale[a] * scale[b] * sum;
    }
  }
  if (!factor(H, k, weakest)) return false;
  for (int i = 0; i < n; ++i) {
    double column[6];
    for (int a = 0; a < k; ++a) column[a] = scale[a] * p.A[n * a + i] * weight[i];
    substitute(H, k, column);
    for (int a = 0; a < k; ++a) K[n * a + i] = scale[a] * column[a];
  }
  return true;
}

// Cost sum_i max(|r_i| - bound_i, 0)^2 / variance_i + y^T y over the unknowns y in units of the
// prior: convex, smooth, piecewise quadratic. `beyond`: residuals minus the bound.
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
  // Half the gradient at y, where the cost was evaluated; returns its largest entry.
  double gradient(const double *y, double *g) const {
    double largest = 0.0;
    for (int a = 0; a < p.k; ++a) {
      g[a] = y[a];
      for (int i = 0; i < p.n; ++i) g[a] -= scale[a] * p.A[p.n * a + i] * beyond[i] / p.variance[i];
      largest = std::max(largest, std::fabs(g[a]));
    }
    return largest;
  }
  // Factorises half the Hessian; joints within their bound contribute nothing.
  bool hessian(double *H) const {
    for (int a = 0; a < p.k; ++a)
      for (int b = 0; b <= a; ++b) {
        double sum = a == b ? 1.0 : 0.0;
        for (int i = 0; i < p.n; ++i)
          if (beyond[i] != 0.0)
            sum += scale[a] * scale[b] * p.A[p.n * a + i] * p.A[p.n * b + i] / p.variance[i];
        H[p.k * a + b] = sum;
      }
    return factor(H, p.k);
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

// Semismooth Newton with step halving; exact once no joint crosses its bound.
void newton(const WrenchProblem &p, WrenchSolution &s) {
  const int k = p.k;
  BandCost cost(p);
  double y[6] = {}, value = cost(y);
  for (s.iterations = 0; s.iterations < newton_limit; ++s.iterations) {
    double g[6], step[6], H[36], trial[6];
    if (cost.gradient(y, g) == 0.0) break;
    if (!cost.hessian(H)) break;
    std::copy_n(g, k, step);
    substitute(H, k, step);
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
    if (!(next < value)) {  // converged to double precision
      value = cost(y);
      break;
    }
    std::copy_n(trial, k, y);
    value = next;
    if (length * size < 1e-13) break;
  }
  finish(cost, y, s);
}

// d <- clip(e - A^T x, -bound, bound); x <- MAP(e - d). Converges monotonically but slowly.
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
  if (method == WrenchMethod::clip) return clip(p, s);
  if (method == WrenchMethod::bounded || method == WrenchMethod::interval) return newton(p, s);
  const bool found = method == WrenchMethod::map ? map_gain(p, K)
                     : method == WrenchMethod::lund
                         ? printed_gain(p, K)
                         : least_squares_gain(p, method == WrenchMethod::ls, K);
  if (!found) return undetermined(p, s);
  joseph(p, K, s.x, s.P);
}

namespace {

constexpr int pivot_limit = 200;  // 1e5 random problems needed at most 12
constexpr double tolerance = 1e-10;

// Solves M x = b (or M^T x = b) for M (k, k) by elimination with row pivoting; false if singular.
bool solve(const double *M, int k, bool transposed, const double *b, double *x) {
  double W[6][7];
  for (int i = 0; i < k; ++i) {
    for (int j = 0; j < k; ++j) W[i][j] = transposed ? M[k * j + i] : M[k * i + j];
    W[i][k] = b[i];
  }
  for (int c = 0; c < k; ++c) {
    int pivot = c;
    for (int i = c + 1; i < k; ++i)
      if (std::fabs(W[i][c]) > std::fabs(W[pivot][c])) pivot = i;
    if (!(std::fabs(W[pivot][c]) > 1e-14)) return false;
    for (int j = c; j <= k; ++j) std::swap(W[c][j], W[pivot][j]);
    for (int i = c + 1; i < k; ++i) {
      const double f = W[i][c] / W[c][c];
      for (int j = c; j <= k; ++j) W[i][j] -= f * W[c][j];
    }
  }
  for (int i = k - 1; i >= 0; --i) {
    x[i] = W[i][k];
    for (int j = i + 1; j < k; ++j) x[i] -= W[i][j] * x[j];
    x[i] /= W[i][i];
  }
  return true;
}

// Constraints -box <= x_a <= box and e_i - spread_i <= A_i^T x <= e_i + spread_i, in units of the
// box.
struct Polytope {
  int k, rows;
  double normal[6 + max_joints][6], low[6 + max_joints], high[6 + max_joints];

  double value(int row, const double *x) const {
    double sum = 0.0;
    for (int a = 0; a < k; ++a) sum += normal[row][a] * x[a];
    return sum;
  }
};

struct Vertex {
  int row[6];     // the k active constraints
  bool upper[6];  // active at the upper end
  double x[6];

  bool place(const Polytope &set) {
    double M[36], b[6];
    for (int i = 0; i < set.k; ++i) {
      std::copy_n(set.normal[row[i]], set.k, M + set.k * i);
      b[i] = upper[i] ? set.high[row[i]] : set.low[row[i]];
    }
    return solve(M, set.k, false, b, x);
  }
};

enum class Outcome { found, empty, failed };

// Maximises c^T x by the dual simplex method. Starts at the corner of the box in the direction of
// c, which is dual feasible, and adds the most violated constraint until none is violated.
// `entering`: the last violated constraint.
Outcome maximise(const Polytope &set, const double *c, Vertex &v, int &entering) {
  const int k = set.k;
  for (int a = 0; a < k; ++a) {
    v.row[a] = a;
    v.upper[a] = c[a] >= 0.0;
  }
  for (int pivot = 0; pivot < pivot_limit; ++pivot) {
    if (!v.place(set)) return Outcome::failed;
    double worst = tolerance;
    entering = -1;
    bool above = false;
    for (int r = 0; r < set.rows; ++r) {
      const double value = set.value(r, v.x), over = value - set.high[r],
                   under = set.low[r] - value;
      if (std::max(over, under) > worst) {
        worst = std::max(over, under);
        entering = r;
        above = over > under;
      }
    }
    if (entering < 0) return Outcome::found;
    double M[36], y[6], alpha[6];
    for (int i = 0; i < k; ++i) std::copy_n(set.normal[v.row[i]], k, M + k * i);
    if (!solve(M, k, true, c, y) || !solve(M, k, true, set.normal[entering], alpha))
      return Outcome::failed;
    int leaving = -1;
    double least = 0.0;
    for (int i = 0; i < k; ++i) {
      const double rate = (above ? alpha[i] : -alpha[i]) * (v.upper[i] ? 1.0 : -1.0);
      if (!(rate > 1e-11)) continue;
      const double room = std::max((v.upper[i] ? y[i] : -y[i]), 0.0) / rate;
      if (leaving < 0 || room < least) {
        least = room;
        leaving = i;
      }
    }
    if (leaving < 0) return Outcome::empty;
    v.row[leaving] = entering;
    v.upper[leaving] = above;
  }
  return Outcome::failed;
}

}  // namespace

bool wrench_interval(int n, int k, const double *A, const double *error, const double *spread,
    const double *box, double *interval, bool *violated) {
  Polytope set{k, k + n, {}, {}, {}};
  std::fill_n(violated, n, false);
  const auto unknown = [](double x) { return !std::isfinite(x); };
  if (std::any_of(A, A + k * n, unknown) || std::any_of(error, error + n, unknown)) {
    std::fill_n(interval, 2 * k, std::numeric_limits<double>::quiet_NaN());
    return true;
  }
  for (int a = 0; a < k; ++a) {
    set.normal[a][a] = 1.0;
    set.low[a] = -1.0;
    set.high[a] = 1.0;
  }
  for (int i = 0; i < n; ++i) {  // rows scaled to size 1, so one tolerance applies to all
    double size = 1e-300;
    for (int a = 0; a < k; ++a) size = std::max(size, std::fabs(A[n * a + i] * box[a]));
    for (int a = 0; a < k; ++a) set.normal[k + i][a] = A[n * a + i] * box[a] / size;
    set.low[k + i] = (error[i] - spread[i]) / size;
    set.high[k + i] = (error[i] + spread[i]) / size;
  }
  for (int a = 0; a < k; ++a)
    for (int end = 0; end < 2; ++end) {
      // Small weights on all other axes break ties, which could make a simplex method cycle. The
      // result is widened by their largest effect.
      double c[6], margin = 0.0;
      for (int b = 0; b < k; ++b) margin += 2.0 * (c[b] = 1e-11 * (1.0 + 0.1 * b));
      c[a] = end ? 1.0 : -1.0;
      Vertex v;
      int entering;
      const Outcome outcome = maximise(set, c, v, entering);
      if (outcome == Outcome::empty) {
        if (entering >= k) violated[entering - k] = true;
        for (int i = 0; i < k; ++i)
          if (v.row[i] >= k) violated[v.row[i] - k] = true;
        return false;
      }
      // Without a solution, the box is the only bound.
      const double reach = outcome == Outcome::found ? c[a] * v.x[a] + margin : 1.0;
      interval[2 * a + end] = c[a] * box[a] * std::min(reach, 1.0);
    }
  return true;
}

}  // namespace armlab
