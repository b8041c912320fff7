#include "math/motion/primitive.h"
#include "array/lanes.h"

namespace armlab {
namespace {

// exp(x) for -700 < x <= 0 with an error below 1.5 units in the last place; NaN gives NaN. First,
// x = k ln 2 + r with ln 2 in two parts; the first has 32 bits, so k times it is exact. Then the
// series of exp(r) for |r| <= ln(2) / 2, with a remainder below 5e-18. Finally, k is added to the
// exponent.
ARMLAB_INLINE double exponential(double x) {
  constexpr double shifter = 0x1.8p52, one_over_ln2 = 0x1.71547652b82fep0;
  constexpr double ln2_1 = 0x1.62e42fee00000p-1, ln2_2 = 0x1.a39ef35793c76p-33;
  const double shifted = x * one_over_ln2 + shifter, k = shifted - shifter;
  const double r = (x - k * ln2_1) - k * ln2_2, r2 = r * r, r4 = r2 * r2;
  const double low = (0.5 + r * (1.0 / 6)) + r2 * (1.0 / 24 + r * (1.0 / 120));
  const double middle = (1.0 / 720 + r * (1.0 / 5040)) + r2 * (1.0 / 40320 + r * (1.0 / 362880));
  const double high =
      (1.0 / 3628800 + r * (1.0 / 39916800)) + r2 * (1.0 / 479001600 + r * (1.0 / 6227020800.0));
  const double e = 1.0 + (r + r2 * (low + r4 * (middle + r4 * high)));
  return from_bits(to_bits(e) + (to_bits(shifted) << 52));
}

constexpr double faded = 40.0;      // exponents this far below the largest are dropped: 4e-18
constexpr double gate_width = 0.1;  // share of the duration over which time-phase forcing fades

}  // namespace

double Primitive::phase_at(double s) const {
  return phase == PhaseKind::canonical ? std::exp(-decay * s) : pace * s;
}

double Primitive::share(double x) const {
  if (phase == PhaseKind::periodic) return 1.0;
  if (phase != PhaseKind::time) return x;
  const double late = std::min(std::max((x - 1.0) / gate_width, 0.0), 1.0);
  return 1.0 - late * late * late * (late * (6.0 * late - 15.0) + 10.0);
}

int Primitive::kernels(double x, double factor, int *index, double *psi) const {
  for (int j = 0; j < m; ++j) {
    const double off =
        phase == PhaseKind::periodic ? 2.0 * std::sin(0.5 * (x - centres[j])) : x - centres[j];
    psi[j] = -off * off * curvatures[j];
  }
  double tops[4];  // four at once, because each maximum waits for the previous one
  std::fill_n(tops, 4, psi[0]);
  int next = 0;
  for (; next + 4 <= m; next += 4)
    for (int lane = 0; lane < 4; ++lane) tops[lane] = std::max(tops[lane], psi[next + lane]);
  for (; next < m; ++next) tops[0] = std::max(tops[0], psi[next]);
  const double top = std::max(std::max(tops[0], tops[1]), std::max(tops[2], tops[3]));
  int count = 0;
  double sum = 0.0;
  for (int j = 0; j < m; ++j) {
    if (psi[j] < top - faded) continue;
    index[count] = j;
    psi[count++] = psi[j] - top;
  }
  for (int k = 0; k < count; ++k) psi[k] = exponential(psi[k]);
  for (int k = 0; k < count; ++k) sum += psi[k];
  for (int k = 0; k < count; ++k) psi[k] *= factor / sum;
  return count;
}

ARMLAB_VECTORISED void Primitive::basis(std::ptrdiff_t N, const double *x, const double *factors,
    std::ptrdiff_t row, std::ptrdiff_t column, double *psi) const {
  std::vector<double> values(m);
  std::vector<int> index(m);
  for (std::ptrdiff_t k = 0; k < N; ++k) {
    const int count = kernels(x[k], factors ? factors[k] : 1.0, index.data(), values.data());
    for (int l = 0; l < count; ++l) psi[k * row + index[l] * column] = values[l];
  }
}

void Primitive::forcing(double x, int *index, double *psi, double *f) const {
  const int count = kernels(x, share(x), index, psi);
  std::fill(f, f + n, 0.0);
  for (int k = 0; k < count; ++k) {
    const double *w = weights.data() + static_cast<std::ptrdiff_t>(n) * index[k];
    for (int i = 0; i < n; ++i) f[i] += psi[k] * w[i];
  }
}

void Primitive::forcing_each(const double *x, int *index, double *psi, double *f) const {
  for (int i = 0; i < n; ++i) {
    const int count = kernels(x[i], x[i], index, psi);
    f[i] = 0.0;
    for (int k = 0; k < count; ++k)
      f[i] += psi[k] * weights[static_cast<std::ptrdiff_t>(n) * index[k] + i];
  }
}

namespace {

constexpr std::ptrdiff_t together = 32;  // runs per group: their states fit in the L1 cache

// Writes position, velocity, acceleration and forcing of a state.
inline void write(std::ptrdiff_t count, const double *y, const double *z, const double *g,
    const double *f, double stiffness, double alpha, double rate, double *__restrict Y,
    double *__restrict V, double *__restrict A, double *__restrict F) {
  for (std::ptrdiff_t i = 0; i < count; ++i) {
    Y[i] = y[i];
    V[i] = z[i] * rate;
    A[i] = (stiffness * (g[i] - y[i]) - alpha * z[i] + f[i]) * (rate * rate);
    F[i] = f[i];
  }
}

// to (n) = scale * sum psi w over the active kernels; n_known > 0 fixes n at compile time
template <int n_known>
inline void weigh(int n_given, int count, const int *index, const double *psi,
    const double *weights, const double *scale, double *to) {
  constexpr int most = n_known ? n_known : 1;
  const int n = n_known ? n_known : n_given;
  double fixed[most] = {}, *sum = n_known ? fixed : to;
  if (!n_known) std::fill(to, to + n, 0.0);
  for (int l = 0; l < count; ++l) {
    const double *w = weights + static_cast<std::ptrdiff_t>(n) * index[l];
    for (int i = 0; i < n; ++i) sum[i] += psi[l] * w[i];
  }
  for (int i = 0; i < n; ++i) to[i] = sum[i] * scale[i];
}

inline void weigh_any(int n, int count, const int *index, const double *psi, const double *w,
    const double *s, double *to) {
  if (n == 1) return weigh<1>(n, count, index, psi, w, s, to);
  if (n == 2) return weigh<2>(n, count, index, psi, w, s, to);
  if (n == 3) return weigh<3>(n, count, index, psi, w, s, to);
  if (n == 6) return weigh<6>(n, count, index, psi, w, s, to);
  if (n == 7) return weigh<7>(n, count, index, psi, w, s, to);
  weigh<0>(n, count, index, psi, w, s, to);
}

// Data shared by all runs on one clock: steps, and the forcing at their starts and midpoints.
struct Course {
  std::vector<SpringStep> steps;
  std::vector<double> forces;  // (2 N - 1, n) for the weights of the primitive
  std::vector<double> psi;     // (2 N - 1, m) kernels, for runs with individual weights: `counts`
  std::vector<int> index, counts;
};

ARMLAB_VECTORISED void plan(
    const Primitive &p, std::ptrdiff_t N, const double *t, double tau, bool own, Course &course) {
  const std::ptrdiff_t points = 2 * N - 1;
  std::vector<double> values(p.m);
  std::vector<int> numbers(p.m);
  course.steps.resize(N - 1);
  course.forces.resize(own ? 0 : points * p.n);
  course.psi.resize(own ? points * p.m : 0);
  course.index.resize(own ? points * p.m : 0);
  course.counts.resize(own ? points : 0);
  for (std::ptrdiff_t k = 0; k < points; ++k) {
    const double at = k % 2 ? 0.5 * (t[k / 2] + t[k / 2 + 1]) : t[k / 2],
                 x = p.phase_at((at - t[0]) / tau);
    if (own)
      course.counts[k] =
          p.kernels(x, p.share(x), course.index.data() + k * p.m, course.psi.data() + k * p.m);
    else p.forcing(x, numbers.data(), values.data(), course.forces.data() + k * p.n);
  }
  for (std::ptrdiff_t k = 0; k + 1 < N; ++k) {
    const double r = (t[k + 1] - t[k]) / tau;
    course.steps[k] = SpringStep(p.alpha, p.stiffness, r);
  }
}

ARMLAB_VECTORISED void run_together(const Primitive &p, const Course &course, std::ptrdiff_t N,
    double tau, std::ptrdiff_t K, std::ptrdiff_t begin, std::ptrdiff_t runs, const double *y0,
    const double *v0, const double *g, const double *scale, const double *weights, double *Y,
    double *V, double *A, double *F) {
  const std::ptrdiff_t n = p.n, count = runs * n;
  std::vector<double> state(5 * count);
  double *y = state.data(), *z = y + count, *f0 = z + count, *fm = f0 + count, *f1 = fm + count;
  const double rate = 1.0 / tau;
  y0 += begin * n;
  v0 += begin * n;
  g += begin * n;
  scale += begin * n;
  const auto force = [&](std::ptrdiff_t k, double *f) {
    if (!weights) {
      const double *shared = course.forces.data() + k * n;
      for (std::ptrdiff_t run = 0; run < runs; ++run)
        for (std::ptrdiff_t i = 0; i < n; ++i) f[run * n + i] = scale[run * n + i] * shared[i];
      return;
    }
    for (std::ptrdiff_t run = 0; run < runs; ++run)
      weigh_any(p.n, course.counts[k], course.index.data() + k * p.m, course.psi.data() + k * p.m,
          weights + (begin + run) * p.m * n, scale + run * n, f + run * n);
  };
  for (std::ptrdiff_t i = 0; i < count; ++i) {
    y[i] = y0[i];
    z[i] = tau * v0[i];
  }
  force(0, f0);
  for (std::ptrdiff_t k = 0; k < N; ++k) {
    const std::ptrdiff_t at = (k * K + begin) * n;
    if (k > 0) {
      force(2 * k - 1, fm);
      force(2 * k, f1);
      course.steps[k - 1].advance(count, f0, fm, f1, g, y, z);
      std::swap(f0, f1);
    }
    write(count, y, z, g, f0, p.stiffness, p.alpha, rate, Y + at, V + at, A + at, F + at);
  }
}

void run_position(const Primitive &p, std::ptrdiff_t N, const double *t, double tau,
    std::ptrdiff_t K, std::ptrdiff_t number, const double *y0, const double *v0, const double *g,
    const double *scale, const double *weights, double *Y, double *V, double *A, double *F) {
  PrimitiveStepper run(p);
  const std::ptrdiff_t n = p.n, first = number * n;
  if (weights) std::copy_n(weights + number * p.m * n, p.m * n, run.primitive.weights.begin());
  run.start(y0 + first, v0 + first, g + first, scale + first, tau);
  for (std::ptrdiff_t k = 0; k < N; ++k) {
    if (k > 0) run.step(t[k] - t[k - 1]);
    const std::ptrdiff_t at = k * K * n + first;
    run.outputs(Y + at, V + at, A + at, F + at);
  }
}

}  // namespace

void rollout(const Primitive &p, std::ptrdiff_t N, const double *t, double tau, std::ptrdiff_t K,
    const double *y0, const double *v0, const double *g, const double *scale, const double *weights,
    double *y, double *yd, double *ydd, double *x, double *f) {
  for (std::ptrdiff_t k = 0; k < N; ++k) x[k] = p.phase_at((t[k] - t[0]) / tau);
  if (p.phase == PhaseKind::position) {
    for (std::ptrdiff_t run = 0; run < K; ++run)
      run_position(p, N, t, tau, K, run, y0, v0, g, scale, weights, y, yd, ydd, f);
    return;
  }
  Course course;
  plan(p, N, t, tau, weights != nullptr, course);
  for (std::ptrdiff_t begin = 0; begin < K; begin += together)
    run_together(p, course, N, tau, K, begin, std::min(together, K - begin), y0, v0, g, scale,
        weights, y, yd, ydd, f);
}

ARMLAB_VECTORISED void response(const Primitive &p, std::ptrdiff_t N, const double *t, double tau,
    double longest, double *Y, double *V) {
  const std::ptrdiff_t m = p.m, columns = m + 3;
  std::vector<double> state(6 * columns), psi(m);
  std::vector<int> index(m);
  double *y = state.data(), *z = y + columns, *f0 = z + columns, *fm = f0 + columns,
         *f1 = fm + columns, *g = f1 + columns;
  y[m] = 1.0;
  z[m + 1] = tau;
  g[m + 2] = 1.0;
  const auto force = [&](double s, double *f) {
    std::fill(f, f + m, 0.0);
    const double x = p.phase_at(s);
    const int count = p.kernels(x, p.share(x), index.data(), psi.data());
    for (int k = 0; k < count; ++k) f[index[k]] = psi[k];
  };
  force(0.0, f0);
  SpringStep step{};
  const double rate = 1.0 / tau;
  double last = -1.0;
  for (std::ptrdiff_t k = 0; k < N; ++k) {
    if (k > 0) {
      const double parts = std::max(std::ceil((t[k] - t[k - 1]) / longest), 1.0),
                   r = (t[k] - t[k - 1]) / parts / tau;
      if (r != last) step = SpringStep(p.alpha, p.stiffness, last = r);
      for (double part = 0.0; part < parts; part += 1.0) {
        const double s = (t[k - 1] - t[0]) / tau + part * r;
        force(s + 0.5 * r, fm);
        force(s + r, f1);
        step.advance(columns, f0, fm, f1, g, y, z);
        std::swap(f0, f1);
      }
    }
    for (std::ptrdiff_t j = 0; j < columns; ++j) {
      Y[k * columns + j] = y[j];
      V[k * columns + j] = z[j] * rate;
    }
  }
}

namespace {

constexpr double coupled_step = 0.35;  // step with a coupling, in time constants of the spring

}  // namespace

PrimitiveStepper::PrimitiveStepper(const Primitive &p)
    : primitive(p), work_(8 * p.n), psi_(p.m), index_(p.m) {
  for (auto *part : {&y_, &z_, &y0_, &g_, &target_, &scale_, &f0_, &fm_, &f1_, &goal_, &rise_,
           &limit_, &side_, &braking_})
    part->assign(p.n, 0.0);
}

void PrimitiveStepper::start(
    const double *y0, const double *v0, const double *g, const double *scale, double tau) {
  const int n = primitive.n;
  tau_ = tau;
  s_ = 0.0;
  moving_ = false;
  for (int i = 0; i < n; ++i) {
    y_[i] = y0_[i] = y0[i];
    z_[i] = tau * v0[i];
    g_[i] = target_[i] = g[i];
    scale_[i] = scale[i];
    limit_[i] = side_[i] = braking_[i] = rise_[i] = 0.0;
  }
  force(0.0, y_.data(), f0_.data());
}

void PrimitiveStepper::force(double s, const double *y, double *f) {
  const int n = primitive.n;
  if (primitive.phase == PhaseKind::position) {
    double *p = work_.data() + 5 * n;
    for (int i = 0; i < n; ++i) {
      const double way = g_[i] - y0_[i];
      p[i] = way == 0.0 ? 0.0 : std::min(std::max((g_[i] - y[i]) / way, 0.0), 1.0);
    }
    primitive.forcing_each(p, index_.data(), psi_.data(), f);
  } else {
    primitive.forcing(primitive.phase_at(s), index_.data(), psi_.data(), f);
  }
  const double left = moving_ ? std::exp(-filter * (s - moved_)) : 0.0;
  for (int i = 0; i < n; ++i) f[i] *= scale_[i] + rise_[i] * left;
}

void PrimitiveStepper::step(double dt) {
  const double r = dt / tau_;
  if (coupling) step_coupled(r);
  else if (primitive.phase == PhaseKind::position) step_position(r);
  else step_spring(r);
  brake();
}

void PrimitiveStepper::step_spring(double r) {
  const int n = primitive.n;
  if (r != r_) spring_ = SpringStep(primitive.alpha, primitive.stiffness, r_ = r);
  force(s_ + 0.5 * r, nullptr, fm_.data());
  force(s_ += r, nullptr, f1_.data());
  if (!moving_) {
    spring_.advance(n, f0_.data(), fm_.data(), f1_.data(), g_.data(), y_.data(), z_.data());
  } else {  // relative to the target; the goal's remaining distance acts as a force
    double *start = work_.data(), *middle = start + n, *end = middle + n;
    const double half = std::exp(-0.5 * filter * r), k = primitive.stiffness;
    for (int i = 0; i < n; ++i) {
      const double ahead = k * (g_[i] - target_[i]);
      start[i] = f0_[i] + ahead;
      middle[i] = fm_[i] + ahead * half;
      end[i] = f1_[i] + ahead * half * half;
      g_[i] = target_[i] + (g_[i] - target_[i]) * half * half;
    }
    spring_.advance(n, start, middle, end, target_.data(), y_.data(), z_.data());
  }
  f0_.swap(f1_);
}

// Divides the step for the spring: the forcing depends on the state.
void PrimitiveStepper::step_position(double r) {
  const double parts =
      std::max(std::ceil(std::max(primitive.alpha, std::sqrt(primitive.stiffness)) * r), 1.0);
  for (double part = 0.0; part < parts; part += 1.0) step_runge(r / parts);
}

// Exact without external terms; otherwise in steps that are short for the spring.
void PrimitiveStepper::step_coupled(double r) {
  const double stiff = std::max(primitive.alpha, std::sqrt(primitive.stiffness)) * r;
  const double parts = std::max(std::ceil(stiff / coupled_step), 1.0), h = r / parts;
  for (double part = 0.0; part < parts; part += 1.0) {
    if (primitive.phase == PhaseKind::position || coupling->acts(y_.data())) {
      step_runge(h);
    } else {
      step_spring(h);
      coupling->advance(h * tau_);
    }
  }
}

void PrimitiveStepper::step_runge(double h) {
  const int n = primitive.n;
  double *y = work_.data(), *z = y + n, *sum_y = z + n, *sum_z = sum_y + n, *f = sum_z + n,
         *v = f + 2 * n, *a = v + n;
  for (int stage = 0; stage < 4; ++stage) {
    const double reach = stage == 3 ? h : 0.5 * h,
                 weight = stage == 0 || stage == 3 ? h / 6.0 : h / 3.0;
    if (stage == 0) {
      for (int i = 0; i < n; ++i) {
        y[i] = sum_y[i] = y_[i];
        z[i] = sum_z[i] = z_[i];
      }
    }
    const double now = s_ + (stage == 0 ? 0.0 : reach);
    if (moving_)
      for (int i = 0; i < n; ++i)
        g_[i] = target_[i] + goal_[i] * std::exp(-filter * (now - moved_));
    force(now, y, f);
    if (coupling && stage % 2 == 1) coupling->advance(0.5 * h * tau_);
    for (int i = 0; i < n; ++i)
      a[i] = primitive.stiffness * (g_[i] - y[i]) - primitive.alpha * z[i] + f[i];
    if (coupling) {
      for (int i = 0; i < n; ++i) {
        v[i] = z[i] / tau_;
        a[i] /= tau_ * tau_;
      }
      coupling->add(y, v, g_.data(), a);
      for (int i = 0; i < n; ++i) a[i] *= tau_ * tau_;
    }
    for (int i = 0; i < n; ++i) {
      const double dy = z[i], dz = a[i];
      sum_y[i] += weight * dy;
      sum_z[i] += weight * dz;
      const double next = stage == 2 ? h : 0.5 * h;
      y[i] = y_[i] + next * dy;
      z[i] = z_[i] + next * dz;
    }
  }
  std::copy_n(sum_y, n, y_.data());
  std::copy_n(sum_z, n, z_.data());
  s_ += h;
  if (moving_)
    for (int i = 0; i < n; ++i) g_[i] = target_[i] + goal_[i] * std::exp(-filter * (s_ - moved_));
  force(s_, y_.data(), f0_.data());
}

// Keeps v^2 <= 2 a |g - y| on the way to a changed goal, and prevents y from passing it.
void PrimitiveStepper::brake() {
  for (int i = 0; i < primitive.n; ++i) {
    if (side_[i] == 0.0) continue;
    const double left = side_[i] * (target_[i] - y_[i]), v = side_[i] * z_[i] / tau_;
    braking_[i] = 0.0;
    if (left <= 0.0) {
      y_[i] = target_[i];
      if (v > 0.0) z_[i] = 0.0;
      braking_[i] = 1.0;
    } else if (v > 0.0 && v * v > 2.0 * limit_[i] * left) {
      z_[i] = side_[i] * tau_ * std::sqrt(2.0 * limit_[i] * left);
      braking_[i] = 1.0;
    }
  }
}

void PrimitiveStepper::change_goal(const double *g, const double *scale, const double *limit) {
  const double left = moving_ ? std::exp(-filter * (s_ - moved_)) : 0.0;
  for (int i = 0; i < primitive.n; ++i) {
    rise_[i] = filter == 0.0 ? 0.0 : scale_[i] + rise_[i] * left - scale[i];
    scale_[i] = scale[i];
    target_[i] = g[i];
    if (filter == 0.0) g_[i] = g[i];
    goal_[i] = g_[i] - target_[i];
    const double way = g[i] - y_[i], v = z_[i] / tau_;
    const bool brakes = limit && limit[i] > 0.0 && way * v >= 0.0 && way != 0.0 &&
                        v * v <= 2.0 * limit[i] * std::fabs(way);
    side_[i] = brakes ? std::copysign(1.0, way) : 0.0;
    limit_[i] = limit ? limit[i] : 0.0;
    braking_[i] = 0.0;
  }
  moving_ = filter > 0.0;
  moved_ = s_;
  force(s_, y_.data(), f0_.data());
}

void PrimitiveStepper::change_tau(double tau) {
  for (double &z : z_) z *= tau / tau_;
  tau_ = tau;
}

void PrimitiveStepper::outputs(double *y, double *yd, double *ydd, double *f) const {
  const int n = primitive.n;
  for (int i = 0; i < n; ++i) {
    y[i] = y_[i];
    yd[i] = z_[i] / tau_;
    ydd[i] =
        (primitive.stiffness * (g_[i] - y_[i]) - primitive.alpha * z_[i] + f0_[i]) / (tau_ * tau_);
    if (f) f[i] = f0_[i];
  }
  if (coupling) coupling->add(y, yd, g_.data(), ydd);
  for (int i = 0; i < n; ++i)
    if (braking_[i] != 0.0) ydd[i] = yd[i] == 0.0 ? 0.0 : -side_[i] * limit_[i];
}

}  // namespace armlab
