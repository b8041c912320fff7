// Python class MomentumEstimator and function momentum_step: arguments are checked here, the
// mathematics is in momentum_estimator.cpp and momentum_filter.cpp.
#include <vector>

#include "math/contact/estimates.h"
#include "math/contact/momentum_estimator.h"

namespace armlab {
namespace {

void construct(MomentumEstimator *self, const Chain &chain, nb::handle gravity, nb::handle links,
    nb::handle rotor, const Drive &drive, nb::handle gains, double gain_variance,
    nb::handle covariance, nb::handle prior, nb::handle memory_, nb::handle qd_noise_,
    nb::handle rate_, nb::handle leak_, double gain, bool filters, bool biased, nb::handle point) {
  const int n = chain.n;
  auto p = read_arm<MomentumEstimator::Parameters>(
      chain, gravity, links, rotor, drive, gains, gain_variance, covariance, prior, point);
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
  const npy_intp shape[2] = {N, N};
  const nb::object new_x = fresh_array(1, shape, x.data()), new_P = fresh_array(2, shape, P.data());
  std::vector<double> work(4 * N * N);
  if (!momentum_step({n, m, G.data(), Qp.data(), q.data(), a.data()}, u.data(), y.data(), R.data(),
          h, numbers(new_x), numbers(new_P), work.data()))
    raise_shape_error(
        "Expected Qp, q and R that leave the measured momentum a positive covariance, got others. "
        "Give "
        "positive variances.");
  return nb::make_tuple(new_x, new_P);
}

}  // namespace
}  // namespace armlab

void bind_momentum(nb::module_ &m) {
  using namespace armlab;
  using nb::arg;
  nb::class_<MomentumEstimator>(
      m, "MomentumEstimator", "Contact wrench by momentum; see tests/oracles/momentum.py.")
      .def("__init__", &construct, arg("chain"), array("gravity"), array("links"), array("rotor"),
          arg("drive"), array("gains"), arg("gain_variance"), array("covariance"), array("prior"),
          array("memory"), array("qd_noise"), array("rate"), array("leak"), arg("gain"),
          arg("filters"), arg("biased"), arg("point") = nb::none())
      .def("reset", &MomentumEstimator::reset, "Forget everything but the parameters.")
      .def("tare", &MomentumEstimator::tare,
          "Call what the torques show now friction; False unless all joints rest.")
      .def("step", &step<MomentumEstimator>, array("q"), array("qd"), array("tau"), arg("dt"),
          "Advance by one sample; return F, P, observability, torque error, its variance, flags, "
          "active, None.")
      .def("run", &run<MomentumEstimator>, array("q"), array("qd"), array("tau"), array("dt"),
          "Step along a record (N, n); return the outputs of step stacked over N.");
  m.def("momentum_step", &filter_step, array("x"), array("P"), array("G"), array("u"), array("y"),
      array("R"), arg("h"), array("Qp"), array("q"), array("a"),
      "One step of the momentum filter; see tests/oracles/momentum.py.");
}
