// Twelve small linear programmes by a dual simplex with bounded rows.
#include <limits>

#include "math/contact/wrench.h"

namespace armlab {
namespace {

constexpr int pivot_limit = 200;  // 12 were needed at most in 1e5 random problems
constexpr double tolerance = 1e-10;

// Solves M x = b (or M^T x = b), M (k, k), by elimination with row pivots; false when singular.
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

// Rows -box <= x_a <= box, then e_i - spread_i <= A_i^T x <= e_i + spread_i, in units of the box.
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
  int row[6];     // the k rows that hold with equality
  bool upper[6];  // at their upper end
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

// Maximises c^T x. Starts at the corner of the box that c points to, which is dual feasible, and
// lets in the row that is violated most until none is. `entering`: the last row left out.
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
  for (int i = 0; i < n; ++i) {  // rows scaled to size 1, so that one tolerance serves all
    double size = 1e-300;
    for (int a = 0; a < k; ++a) size = std::max(size, std::fabs(A[n * a + i] * box[a]));
    for (int a = 0; a < k; ++a) set.normal[k + i][a] = A[n * a + i] * box[a] / size;
    set.low[k + i] = (error[i] - spread[i]) / size;
    set.high[k + i] = (error[i] + spread[i]) / size;
  }
  for (int a = 0; a < k; ++a)
    for (int end = 0; end < 2; ++end) {
      // A little of every other axis settles ties, by which a simplex could go in circles; the end
      // moves out by as much as that can have cost.
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
      // Without an answer the box is what is known.
      const double reach = outcome == Outcome::found ? c[a] * v.x[a] + margin : 1.0;
      interval[2 * a + end] = c[a] * box[a] * std::min(reach, 1.0);
    }
  return true;
}

}  // namespace armlab
