// Python class WrenchEstimator and function presliding: arguments are checked here, the mathematics is in estimator.cpp.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "arrays.h"
#include "estimator.h"

namespace armlab {
namespace {

void construct(WrenchEstimator *self, const Chain &chain, nb::handle gravity_, nb::handle links_, nb::handle rotor_,
               nb::handle friction_, nb::handle ripple_, nb::handle covariance_, nb::handle prior_, double cutoff) {
  const int n = chain.n;
  const Input gravity(gravity_, "gravity"), links(links_, "links"), rotor(rotor_, "rotor"), friction(friction_, "friction");
  const Input ripple(ripple_, "ripple"), covariance(covariance_, "covariance"), prior(prior_, "prior");
  gravity.require_exactly({3});
  links.require_exactly({n, 10});
  rotor.require_exactly({n});
  friction.require_exactly({8, n});
  ripple.require_exactly({3, n});
  covariance.require_exactly({4, n});
  prior.require_exactly({6});
  WrenchEstimator::Parameters p(chain);
  std::copy_n(gravity.data(), 3, p.gravity.begin());
  std::copy_n(links.data(), 10 * n, p.links.begin());
  std::copy_n(rotor.data(), n, p.rotor.begin());
  std::copy_n(prior.data(), 6, p.prior.begin());
  const double *f = friction.data(), *r = ripple.data(), *c = covariance.data();
  for (int i = 0; i < n; ++i) {
    p.friction[i] = {f[i], f[n + i], f[2 * n + i], f[3 * n + i], f[4 * n + i], f[5 * n + i], f[6 * n + i], f[7 * n + i]};
    p.ripple[i] = {r[i], r[n + i], r[2 * n + i]};
    p.covariance[i] = {c[i], c[n + i], c[2 * n + i], c[3 * n + i]};
  }
  p.cutoff = cutoff;
  new (self) WrenchEstimator(p);
}

nb::object vector_of(int n, const double *values) {
  const npy_intp shape[1] = {n};
  return fresh_array(1, shape, values);
}

nb::object step(WrenchEstimator &self, nb::handle q_, nb::handle qd_, nb::handle tau_, double dt) {
  const int n = self.n();
  const Input q(q_, "q"), qd(qd_, "qd"), tau(tau_, "tau");
  q.require_exactly({n});
  qd.require_exactly({n});
  tau.require_exactly({n});
  double F[6], P[36], observability[6], error[max_joints], variance[max_joints];
  self.step(q.data(), qd.data(), tau.data(), dt, F, P, observability, error, variance);
  const npy_intp square[2] = {6, 6};
  return nb::steal(PyTuple_Pack(5, vector_of(6, F).ptr(), fresh_array(2, square, P).ptr(), vector_of(6, observability).ptr(),
                                vector_of(n, error).ptr(), vector_of(n, variance).ptr()));
}

// A fresh array of shape (N, tail) and a pointer to its numbers.
nb::object fresh(std::vector<npy_intp> shape, double *&data) {
  nb::object array = nb::steal(PyArray_SimpleNew(static_cast<int>(shape.size()), shape.data(), NPY_DOUBLE));
  if (!array) throw nb::python_error();
  data = static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array.ptr())));
  return array;
}

nb::object run(WrenchEstimator &self, nb::handle q_, nb::handle qd_, nb::handle tau_, nb::handle dt_) {
  const int n = self.n();
  const Input q(q_, "q"), qd(qd_, "qd"), tau(tau_, "tau"), dt(dt_, "dt");
  const npy_intp N = dt.size();
  dt.require_exactly({N});
  q.require_exactly({N, n});
  qd.require_exactly({N, n});
  tau.require_exactly({N, n});
  double *F, *P, *observability, *error, *variance;
  const nb::object arrays[5] = {fresh({N, 6}, F), fresh({N, 6, 6}, P), fresh({N, 6}, observability), fresh({N, n}, error),
                                fresh({N, n}, variance)};
  {
    nb::gil_scoped_release released;
    for (npy_intp k = 0; k < N; ++k)
      self.step(q.data() + n * k, qd.data() + n * k, tau.data() + n * k, dt.data()[k], F + 6 * k, P + 36 * k,
                observability + 6 * k, error + n * k, variance + n * k);
  }
  return nb::steal(PyTuple_Pack(5, arrays[0].ptr(), arrays[1].ptr(), arrays[2].ptr(), arrays[3].ptr(), arrays[4].ptr()));
}

nb::object presliding(nb::handle q_, nb::handle delta_, nb::handle resolution_) {
  const Input q(q_, "q"), delta(delta_, "delta"), resolution(resolution_, "resolution");
  const npy_intp n = delta.size(), N = n ? q.size() / n : 0;
  q.require_exactly({N, n});
  delta.require_exactly({n});
  resolution.require_exactly({n});
  double *z;
  nb::object array = fresh({N, n}, z);
  nb::gil_scoped_release released;
  std::vector<double> state(n, 0.0), play;
  for (npy_intp k = 0; k < N; ++k, z += n) {
    const double *row = q.data() + n * k;
    if (!std::all_of(row, row + n, [](double x) { return std::isfinite(x); })) {
      std::fill(z, z + n, std::numeric_limits<double>::quiet_NaN());
      continue;
    }
    if (play.empty()) play.assign(row, row + n);
    for (npy_intp i = 0; i < n; ++i) {
      const double dy = follow(play[i], row[i], resolution.data()[i]);
      z[i] = state[i] = slide(state[i], dy, delta.data()[i]);
    }
  }
  return array;
}

}  // namespace
}  // namespace armlab

void bind_estimator(nb::module_ &m) {
  using namespace armlab;
  nb::class_<WrenchEstimator>(m, "WrenchEstimator",
                              "Contact wrench from joint motion and torque; see armlab/kernels/_reference/estimator.py.")
      .def("__init__", &construct, nb::arg("chain"), nb::arg("gravity"), nb::arg("links"), nb::arg("rotor"),
           nb::arg("friction"), nb::arg("ripple"), nb::arg("covariance"), nb::arg("prior"), nb::arg("cutoff"))
      .def("reset", &WrenchEstimator::reset, "Forget everything but the parameters.")
      .def("step", &step, nb::arg("q"), nb::arg("qd"), nb::arg("tau"), nb::arg("dt"),
           "Advance by one sample; return F, P, observability, filtered torque error and its variance.")
      .def("run", &run, nb::arg("q"), nb::arg("qd"), nb::arg("tau"), nb::arg("dt"),
           "Step along a record (N, n); return the outputs of step stacked over N.");
  m.def("presliding", &presliding, nb::arg("q"), nb::arg("delta"), nb::arg("resolution"),
        "Presliding friction state z (N, n) along positions q (N, n); see armlab/kernels/_reference/presliding.py.");
}
