// Python function momentum_step: arguments are checked here, the mathematics is in momentum_filter.cpp.
#include <vector>

#include "arrays.h"
#include "momentum_filter.h"

namespace armlab {
namespace {

nb::object step(nb::handle x_, nb::handle P_, nb::handle G_, nb::handle u_, nb::handle y_, nb::handle R_, double h,
                nb::handle Qp_, nb::handle q_, nb::handle a_) {
  const Input x(x_, "x"), P(P_, "P"), G(G_, "G"), u(u_, "u"), y(y_, "y"), R(R_, "R"), Qp(Qp_, "Qp"), q(q_, "q"), a(a_, "a");
  if (G.ndim() != 2 || G.shape()[0] < 1 || G.shape()[0] > max_joints || G.shape()[1] > max_inputs)
    raise_shape_error("Expected G of shape (n, m) with n from 1 to 32 and m up to 38, got " + G.shape_text() + ".");
  const int n = static_cast<int>(G.shape()[0]), m = static_cast<int>(G.shape()[1]), N = n + m;
  x.require_exactly({N});
  P.require_exactly({N, N});
  u.require_exactly({n});
  y.require_exactly({n});
  R.require_exactly({n, n});
  Qp.require_exactly({n});
  q.require_exactly({m});
  a.require_exactly({m});
  const npy_intp shape[2] = {N, N};
  const nb::object new_x = fresh_array(1, shape, x.data()), new_P = fresh_array(2, shape, P.data());
  const auto numbers = [](const nb::object &array) {
    return static_cast<double *>(PyArray_DATA(reinterpret_cast<PyArrayObject *>(array.ptr())));
  };
  std::vector<double> work(4 * N * N);
  if (!momentum_step({n, m, G.data(), Qp.data(), q.data(), a.data()}, u.data(), y.data(), R.data(), h, numbers(new_x),
                     numbers(new_P), work.data()))
    raise_shape_error("Expected Qp, q and R that leave the measured momentum a positive covariance, got others. Give "
                      "positive variances.");
  return nb::make_tuple(new_x, new_P);
}

}  // namespace
}  // namespace armlab

void bind_momentum(nb::module_ &m) {
  using armlab::array;
  using nb::arg;
  m.def("momentum_step", &armlab::step, array("x"), array("P"), array("G"), array("u"), array("y"), array("R"),
        arg("h"), array("Qp"), array("q"), array("a"), "One step of the momentum filter; see armlab/kernels/_reference/momentum.py.");
}
