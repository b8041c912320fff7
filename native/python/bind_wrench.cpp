// Python functions solve_wrench and wrench_interval: arguments are checked here, the mathematics is
// in wrench.cpp.
#include <algorithm>
#include <string>

#include "array/arrays.h"
#include "math/contact/wrench.h"

namespace armlab {
namespace {

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
  if (method < 0 || method > 5)
    raise_shape_error("Expected method from 0 to 5, got " + std::to_string(method) + ".");
  WrenchSolution s;
  solve_wrench({n, k, A.data(), error.data(), variance.data(), bound.data(), prior.data()},
      static_cast<WrenchMethod>(method), s);
  const npy_intp shape[2] = {k, k};
  const nb::object x = fresh_array(1, shape, s.x), P = fresh_array(2, shape, s.P),
                   active = fresh_mask(n, s.active);
  return nb::make_tuple(x, P, active, s.iterations, s.kkt, s.singular);
}

nb::object interval(nb::handle A_, nb::handle error_, nb::handle spread_, nb::handle box_) {
  const Input A(A_, "A");
  const int k = unknowns(A), n = static_cast<int>(A.shape()[1]);
  const Input error(error_, "error", {n}), spread(spread_, "spread", {n}), box(box_, "box", {k});
  require_not_negative("spread", spread.data(), n);
  require_positive("box", box.data(), k);
  double ends[12];
  bool violated[max_joints];
  const npy_intp shape[2] = {k, 2};
  if (!wrench_interval(n, k, A.data(), error.data(), spread.data(), box.data(), ends, violated))
    return nb::make_tuple(nb::none(), fresh_mask(n, violated));
  return nb::make_tuple(fresh_array(2, shape, ends), fresh_mask(n, violated));
}

}  // namespace
}  // namespace armlab

void bind_wrench(nb::module_ &m) {
  using namespace armlab;
  m.def("solve_wrench", &solve, array("A"), array("error"), array("variance"), array("bound"),
      array("prior"), nb::arg("method"), "Wrench of one instant; see tests/oracles/wrench.py.");
  m.def("wrench_interval", &interval, array("A"), array("error"), array("spread"), array("box"),
      "Guaranteed interval of each unknown; see tests/oracles/wrench.py.");
}
