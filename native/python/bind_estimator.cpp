// Python class WrenchEstimator: arguments are checked here, the mathematics is in estimator.cpp.
#include <string>

#include "math/contact/estimates.h"

namespace armlab {
namespace {

void construct(WrenchEstimator *self, const Chain &chain, nb::handle gravity, nb::handle links,
    nb::handle rotor, const Drive &drive, nb::handle gains, double gain_variance,
    nb::handle covariance, nb::handle bound_, nb::handle prior, double cutoff, int method,
    nb::handle point) {
  const int n = chain.n;
  auto p = read_arm<WrenchEstimator::Parameters>(
      chain, gravity, links, rotor, drive, gains, gain_variance, covariance, prior, point);
  const Input bound(bound_, "bound", {3, n});
  require_not_negative("bound torque", bound.data(), n);
  require_positive("bound speed", bound.data() + n, n);
  require_not_negative("bound floor", bound.data() + 2 * n, n);
  require_positive("cutoff", &cutoff, 1);
  const double *b = bound.data();
  for (int i = 0; i < n; ++i) p.bound[i] = {b[i], b[n + i], b[2 * n + i]};
  p.cutoff = cutoff;
  if (method < 0 || method >= wrench_methods)
    raise_shape_error("Expected method from 0 to " + std::to_string(wrench_methods - 1) + ", got " +
                      std::to_string(method) + ".");
  p.method = static_cast<WrenchMethod>(method);
  new (self) WrenchEstimator(p);
}

}  // namespace
}  // namespace armlab

void bind_estimator(nb::module_ &m) {
  using namespace armlab;
  nb::class_<WrenchEstimator>(m, "WrenchEstimator",
      "Contact wrench from joint motion and torque; see tests/oracles/estimator.py.")
      .def("__init__", &construct, nb::arg("chain"), array("gravity"), array("links"),
          array("rotor"), nb::arg("drive"), array("gains"), nb::arg("gain_variance"),
          array("covariance"), array("bound"), array("prior"), nb::arg("cutoff"),
          nb::arg("method") = 0, nb::arg("point") = nb::none())
      .def("reset", &WrenchEstimator::reset, "Forget everything but the parameters.")
      .def("step", &step<WrenchEstimator>, array("q"), array("qd"), array("tau"), nb::arg("dt"),
          "Advance by one sample; return F, P, observability, torque error, its variance, flags, "
          "active, interval.")
      .def("run", &run<WrenchEstimator>, array("q"), array("qd"), array("tau"), array("dt"),
          "Step along a record (N, n); return the outputs of step stacked over N.");
}
