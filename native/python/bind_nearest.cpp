// Python function so3_nearest; the mathematics is in nearest.h.
#include "array/arrays.h"
#include "math/lie/nearest.h"

namespace armlab::python {
namespace {

nb::object so3_nearest(nb::handle M_, nb::handle out) {
  const Elements M(M_, "M", {3, 3});
  const Output R(out, "out", {3, 3}, {&M}), sigma(nb::none(), "sigma", {3}, {&M});
  const double *from = M.data();
  double *to = R.samples().data, *told = sigma.samples().data;
  const npy_intp count = M.size() / 9;
  const auto run = [=] {
    for (npy_intp k = 0; k < count; ++k)
      nearest_rotation(Rotation<double>::read(from + 9 * k, 3), told + 3 * k).write(to + 9 * k, 3);
  };
  if (count < 32) {
    run();
  } else {
    nb::gil_scoped_release released;
    run();
  }
  return nb::make_tuple(R.array(), sigma.array());
}

}  // namespace
}  // namespace armlab::python

void bind_nearest(nb::module_ &m) {
  m.def("so3_nearest", &armlab::python::so3_nearest, armlab::array("M"), nb::arg("out") = nb::none());
}
