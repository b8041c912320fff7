// Python classes WrenchEstimator and MomentumEstimator, and functions solve_wrench, wrench_interval
// and momentum_step: checks arguments; mathematics in math/contact.
#include "array/arrays.h"
#include "math/contact/momentum_estimator.h"

namespace armlab::python {
namespace {

WrenchMethod method_of(int number) {
  if (number < 0 || number >= wrench_methods)
    raise_shape_error("Expected method from 0 to " + std::to_string(wrench_methods - 1) + ", got " +
                      std::to_string(number) + ".");
  return static_cast<WrenchMethod>(number);
}

// columns (n, W), padded with -1, covariances (n, W, W) and means (n), or None.
ParameterDoubt read_doubt(int n, nb::handle columns_, nb::handle cov_, nb::handle mean_) {
  ParameterDoubt doubt;
  if (columns_.is_none()) return doubt;
  const Input columns(columns_, "doubt_columns");
  const npy_intp W = columns.ndim() == 2 ? columns.shape()[1] : 0;
  columns.require_exactly({n, W});
  const Input cov(cov_, "doubt_cov", {n, W, W}), mean(mean_, "doubt_mean", {n});
  require_not_negative("doubt_mean", mean.data(), n);
  const double last = 11.0 * n + ParameterDoubt::terms;
  doubt.joints.resize(n);
  for (int i = 0; i < n; ++i) {
    doubt.joints[i].mean = mean.data()[i];
    for (npy_intp k = 0; k < W && columns.data()[W * i + k] >= 0.0; ++k) {
      const double column = columns.data()[W * i + k], *row = cov.data() + W * (W * i + k);
      if (!(column < last) || !finite(row, static_cast<int>(W)) ||
          k >= 11 * n + ParameterDoubt::terms)
        raise_shape_error("Expected doubt_columns below " + std::to_string(static_cast<int>(last)) +
                          " and finite doubt_cov, got other values. Identify again.");
      doubt.joints[i].columns.push_back(static_cast<int>(column));
      doubt.joints[i].cov.insert(doubt.joints[i].cov.end(), row, row + k + 1);
    }
  }
  return doubt;
}

// gains (n). covariance (5, n): rows C0, Cinf, shape, kind, doubt. point: (3) in tool axes, or
// None.
template <class Parameters>
Parameters read_arm(const Chain &chain, nb::handle gravity_, nb::handle links_, nb::handle rotor_,
    const Drive &drive, nb::handle gains_, double gain_variance, nb::handle covariance_,
    nb::handle prior_, nb::handle point_, nb::handle doubt_columns, nb::handle doubt_cov,
    nb::handle doubt_mean) {
  const int n = chain.n;
  const Input gravity(gravity_, "gravity", {3}), links(links_, "links", {n, 10}),
      rotor(rotor_, "rotor", {n});
  if (drive.n != n)
    raise_shape_error("Expected a drive of " + std::to_string(n) + " joints like the chain, got " +
                      std::to_string(drive.n) + ".");
  const Input gains(gains_, "gains", {n}), covariance(covariance_, "covariance", {5, n}),
      prior(prior_, "prior", {6});
  require_positive("gains", gains.data(), n);
  require_not_negative("gain_variance", &gain_variance, 1);
  require_positive("covariance", covariance.data(), 2 * n);
  require_not_negative("covariance shape, kind and doubt", covariance.data() + 2 * n, 3 * n);
  require_positive("prior", prior.data(), 6);
  Parameters p(chain);
  std::copy_n(gravity.data(), 3, p.gravity.begin());
  std::copy_n(links.data(), 10 * n, p.links.begin());
  std::copy_n(rotor.data(), n, p.rotor.begin());
  std::copy_n(prior.data(), 6, p.prior.begin());
  p.drive = drive;
  std::copy_n(gains.data(), n, p.gains.begin());
  p.gain_variance = gain_variance;
  const double *c = covariance.data();
  for (int i = 0; i < n; ++i)
    p.covariance[i] = {c[i], c[n + i], c[2 * n + i], c[3 * n + i], c[4 * n + i]};
  p.doubt = read_doubt(n, doubt_columns, doubt_cov, doubt_mean);
  p.at_point = !point_.is_none();
  if (p.at_point) {
    const Input point(point_, "point", {3});
    if (!finite(point.data(), 3))
      raise_shape_error("Expected a finite point, got NaN or Inf. Correct it.");
    std::copy_n(point.data(), 3, p.point.begin());
  }
  return p;
}

// One estimate, or N estimates, as fresh arrays: F, P, observability, torque error, its variance,
// flags, active joints, interval. The interval is None unless the method provides one.
class Estimates {
 public:
  Estimates(int n, bool has_interval, npy_intp N, bool stacked) : n_(n), interval_(nullptr) {
    const auto shaped = [&](std::initializer_list<npy_intp> tail, int type) {
      npy_intp shape[3] = {N};
      npy_intp *end = std::copy(tail.begin(), tail.end(), stacked ? shape + 1 : shape);
      return fresh_of_type(type, static_cast<int>(end - shape), shape);
    };
    arrays_ = {shaped({6}, NPY_DOUBLE), shaped({6, 6}, NPY_DOUBLE), shaped({6}, NPY_DOUBLE),
        shaped({n_}, NPY_DOUBLE), shaped({n_}, NPY_DOUBLE), shaped({n_}, NPY_BOOL), nb::none(),
        nb::none()};
    for (int k = 0; k < 5; ++k) values_[k] = numbers(arrays_[k]);
    active_ = numbers<npy_bool>(arrays_[5]);
    if (has_interval) {
      arrays_[6] = shaped({6, 2}, NPY_DOUBLE);
      interval_ = numbers(arrays_[6]);
    }
    flags_ = &flag_;
    if (stacked) {
      arrays_[7] = shaped({}, NPY_INT64);
      flags_ = numbers<std::int64_t>(arrays_[7]);
    }
  }

  void put(npy_intp row, const WrenchEstimate &e) {
    const double *from[5] = {e.F, e.P, e.observability, e.error, e.variance};
    const int width[5] = {6, 36, 6, n_, n_};
    for (int k = 0; k < 5; ++k) std::copy_n(from[k], width[k], values_[k] + width[k] * row);
    std::copy_n(e.active, n_, active_ + n_ * row);
    if (interval_) std::copy_n(e.interval, 12, interval_ + 12 * row);
    flags_[row] = e.flags;
  }

  nb::object tuple() {
    if (arrays_[7].is_none()) arrays_[7] = nb::int_(flag_);
    const auto &[F, P, seen, error, variance, active, interval, flags] = arrays_;
    return nb::make_tuple(F, P, seen, error, variance, flags, active, interval);
  }

 private:
  int n_;
  std::array<nb::object, 8> arrays_;
  std::array<double *, 5> values_;
  npy_bool *active_;
  double *interval_;
  std::int64_t *flags_, flag_ = 0;
};

template <class Estimator>
nb::object step(Estimator &self, nb::handle q_, nb::handle qd_, nb::handle tau_, double dt) {
  const int n = self.n();
  const Input q(q_, "q", {n}), qd(qd_, "qd", {n}), tau(tau_, "tau", {n});
  WrenchEstimate estimate;
  self.step(q.data(), qd.data(), tau.data(), dt, estimate);
  Estimates out(n, self.has_interval(), 1, false);
  out.put(0, estimate);
  return out.tuple();
}

template <class Estimator>
nb::object run(Estimator &self, nb::handle q_, nb::handle qd_, nb::handle tau_, nb::handle dt_) {
  const int n = self.n();
  const Input dt(dt_, "dt");
  const npy_intp N = dt.size();
  dt.require_exactly({N});
  const Input q(q_, "q", {N, n}), qd(qd_, "qd", {N, n}), tau(tau_, "tau", {N, n});
  Estimates out(n, self.has_interval(), N, true);
  {
    nb::gil_scoped_release released;
    WrenchEstimate estimate;
    for (npy_intp k = 0; k < N; ++k) {
      self.step(q.data() + n * k, qd.data() + n * k, tau.data() + n * k, dt.data()[k], estimate);
      out.put(k, estimate);
    }
  }
  return out.tuple();
}

template <class Estimator>
void bind_steps(nb::class_<Estimator> &estimator) {
  estimator.def("reset", &Estimator::reset)
      .def("__copy__", [](const Estimator &self) { return Estimator(self); })
      .def("step", &step<Estimator>, array("q"), array("qd"), array("tau"), arg("dt"))
      .def("run", &run<Estimator>, array("q"), array("qd"), array("tau"), array("dt"));
}

void construct_estimator(WrenchEstimator *self, const Chain &chain, nb::handle gravity,
    nb::handle links, nb::handle rotor, const Drive &drive, nb::handle gains, double gain_variance,
    nb::handle covariance, nb::handle bound_, nb::handle prior, double cutoff, int method,
    nb::handle point, nb::handle doubt_columns, nb::handle doubt_cov, nb::handle doubt_mean) {
  const int n = chain.n;
  auto p = read_arm<WrenchEstimator::Parameters>(chain, gravity, links, rotor, drive, gains,
      gain_variance, covariance, prior, point, doubt_columns, doubt_cov, doubt_mean);
  const Input bound(bound_, "bound", {3, n});
  require_not_negative("bound torque", bound.data(), n);
  require_positive("bound speed", bound.data() + n, n);
  require_not_negative("bound floor", bound.data() + 2 * n, n);
  require_positive("cutoff", &cutoff, 1);
  const double *b = bound.data();
  for (int i = 0; i < n; ++i) p.bound[i] = {b[i], b[n + i], b[2 * n + i]};
  p.cutoff = cutoff;
  p.method = method_of(method);
  new (self) WrenchEstimator(p);
}

void construct_momentum(MomentumEstimator *self, const Chain &chain, nb::handle gravity,
    nb::handle links, nb::handle rotor, const Drive &drive, nb::handle gains, double gain_variance,
    nb::handle covariance, nb::handle prior, nb::handle memory_, nb::handle qd_noise_,
    nb::handle rate_, nb::handle leak_, double gain, bool filters, bool biased, nb::handle point,
    nb::handle doubt_columns, nb::handle doubt_cov, nb::handle doubt_mean) {
  const int n = chain.n;
  auto p = read_arm<MomentumEstimator::Parameters>(chain, gravity, links, rotor, drive, gains,
      gain_variance, covariance, prior, point, doubt_columns, doubt_cov, doubt_mean);
  const Input memory(memory_, "memory", {n}), qd_noise(qd_noise_, "qd_noise", {n});
  const Input rate(rate_, "rate", {6}), leak(leak_, "leak", {6});
  require_positive("memory", memory.data(), n);
  require_not_negative("qd_noise", qd_noise.data(), n);
  require_not_negative("rate", rate.data(), 6);
  require_not_negative("leak", leak.data(), 6);
  require_positive("gain", &gain, 1);
  std::copy_n(memory.data(), n, p.memory.begin());
  std::copy_n(qd_noise.data(), n, p.qd_noise.begin());
  std::copy_n(rate.data(), 6, p.rate.begin());
  std::copy_n(leak.data(), 6, p.leak.begin());
  p.gain = gain;
  p.filters = filters;
  p.biased = biased;
  new (self) MomentumEstimator(p);
}

nb::object filter_step(nb::handle x_, nb::handle P_, nb::handle G_, nb::handle u_, nb::handle y_,
    nb::handle R_, double h, nb::handle Qp_, nb::handle q_, nb::handle a_) {
  const Input G(G_, "G");
  if (G.ndim() != 2 || G.shape()[0] < 1 || G.shape()[0] > max_joints || G.shape()[1] > max_inputs)
    raise_shape_error("Expected G of shape (n, m) with n from 1 to 32 and m up to 38, got " +
                      G.shape_text() + ".");
  const int n = static_cast<int>(G.shape()[0]), m = static_cast<int>(G.shape()[1]), N = n + m;
  const Input x(x_, "x", {N}), P(P_, "P", {N, N}), u(u_, "u", {n}), y(y_, "y", {n}),
      R(R_, "R", {n, n});
  const Input Qp(Qp_, "Qp", {n}), q(q_, "q", {m}), a(a_, "a", {m});
  const nb::object new_x = fresh_array({N}, x.data()), new_P = fresh_array({N, N}, P.data());
  std::vector<double> work(4 * N * N);
  if (!momentum_step({n, m, G.data(), Qp.data(), q.data(), a.data()}, u.data(), y.data(), R.data(),
          h, numbers(new_x), numbers(new_P), work.data()))
    raise_shape_error(
        "Expected Qp, q and R that give the measured momentum a positive covariance, got other "
        "values. Pass positive variances.");
  return nb::make_tuple(new_x, new_P);
}

int unknowns(const Input &A) {
  if (A.ndim() != 2 || A.shape()[0] < 1 || A.shape()[0] > 6 || A.shape()[1] < 1 ||
      A.shape()[1] > max_joints)
    raise_shape_error("Expected A of shape (k, n) with k from 1 to 6 and n from 1 to " +
                      std::to_string(max_joints) + " joints, got " + A.shape_text() + ".");
  return static_cast<int>(A.shape()[0]);
}

nb::object solve(nb::handle A_, nb::handle error_, nb::handle variance_, nb::handle bound_,
    nb::handle prior_, int method) {
  const Input A(A_, "A");
  const int k = unknowns(A), n = static_cast<int>(A.shape()[1]);
  const Input error(error_, "error", {n}), variance(variance_, "variance", {n}),
      bound(bound_, "bound", {n});
  const Input prior(prior_, "prior", {k});
  require_positive("variance", variance.data(), n);
  require_not_negative("bound", bound.data(), n);
  require_positive("prior", prior.data(), k);
  WrenchSolution s;
  solve_wrench({n, k, A.data(), error.data(), variance.data(), bound.data(), prior.data()},
      method_of(method), s);
  return nb::make_tuple(fresh_array({k}, s.x), fresh_array({k, k}, s.P), fresh_mask(n, s.active),
      s.iterations, s.kkt, s.singular);
}

nb::object interval(nb::handle A_, nb::handle error_, nb::handle spread_, nb::handle box_) {
  const Input A(A_, "A");
  const int k = unknowns(A), n = static_cast<int>(A.shape()[1]);
  const Input error(error_, "error", {n}), spread(spread_, "spread", {n}), box(box_, "box", {k});
  require_not_negative("spread", spread.data(), n);
  require_positive("box", box.data(), k);
  double ends[12];
  bool violated[max_joints];
  const bool found =
      wrench_interval(n, k, A.data(), error.data(), spread.data(), box.data(), ends, violated);
  return nb::make_tuple(found ? fresh_array({k, 2}, ends) : nb::none(), fresh_mask(n, violated));
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_estimator(nb::module_ &m) {
  auto wrench =
      nb::class_<WrenchEstimator>(m, "WrenchEstimator",
          "Contact wrench from joint motion and torque; see tests/oracles/estimator.py.")
          .def("__init__", &construct_estimator, arg("chain"), array("gravity"), array("links"),
              array("rotor"), arg("drive"), array("gains"), arg("gain_variance"),
              array("covariance"), array("bound"), array("prior"), arg("cutoff"), arg("method") = 0,
              arg("point") = nb::none(), arg("doubt_columns") = nb::none(),
              arg("doubt_cov") = nb::none(), arg("doubt_mean") = nb::none());
  bind_steps(wrench);
  auto momentum =
      nb::class_<MomentumEstimator>(
          m, "MomentumEstimator", "Contact wrench by momentum; see docs/theory/contact_force.md.")
          .def("__init__", &construct_momentum, arg("chain"), array("gravity"), array("links"),
              array("rotor"), arg("drive"), array("gains"), arg("gain_variance"),
              array("covariance"), array("prior"), array("memory"), array("qd_noise"),
              array("rate"), array("leak"), arg("gain"), arg("filters"), arg("biased"),
              arg("point") = nb::none(), arg("doubt_columns") = nb::none(),
              arg("doubt_cov") = nb::none(), arg("doubt_mean") = nb::none())
          .def("tare", &MomentumEstimator::tare);
  bind_steps(momentum);
  m.def("momentum_step", &filter_step, array("x"), array("P"), array("G"), array("u"), array("y"),
      array("R"), arg("h"), array("Qp"), array("q"), array("a"));
  m.def("solve_wrench", &solve, array("A"), array("error"), array("variance"), array("bound"),
      array("prior"), arg("method"));
  m.def("wrench_interval", &interval, array("A"), array("error"), array("spread"), array("box"));
}
