// Python function turned_weight; the mathematics is in weight.h.
#include "math/lie/weight.h"

#include <optional>

#include "array/arrays.h"

namespace armlab::python {
namespace {

nb::object turned_weight(nb::handle R_base_tool, nb::handle force_, nb::handle pull_, nb::handle weight_,
                         nb::handle mass, bool biased) {
  const Input force_any(force_, "force");
  const npy_intp n = force_any.ndim() < 2 ? 1 : force_any.shape()[force_any.ndim() - 2];
  Elements force(force_any.object(), "force", {n, 3}), R(R_base_tool, "R_base_tool", {n, 3, 3});
  std::optional<Elements> weight;
  if (!weight_.is_none()) weight.emplace(weight_, "weight", std::initializer_list<npy_intp>{n});
  if (weight)
    Elements::broadcast({&R, &force, &*weight});
  else
    Elements::broadcast({&R, &force});
  const Input pull(pull_, "pull");
  pull.require_exactly({3});
  const bool free_mass = mass.is_none();
  Weighing in{R.data(), force.data(), weight ? weight->data() : nullptr, pull.data(), n, free_mass, biased,
              free_mass ? 0.0 : nb::cast<double>(mass)};
  const npy_intp d = in.unknowns();
  const nb::none fresh;
  const Output turn(fresh, "R", {3, 3}, {&R}), bias(fresh, "bias", {3}, {&R}), rest(fresh, "residuals", {n, 3}, {&R}),
      cov(fresh, "cov", {d, d}, {&R}), products(fresh, "products", {2, 3, 3}, {&R}), told(fresh, "numbers", {8}, {&R});
  const npy_intp count = n ? R.size() / (9 * n) : 0;
  auto run = [&, of = Weighed{turn.samples().data, bias.samples().data, rest.samples().data, cov.samples().data,
                                    products.samples().data, told.samples().data}]() mutable {
    for (npy_intp k = 0; k < count; ++k) {
      armlab::turned_weight(in, of);
      in.R += 9 * n, in.force += 3 * n, in.weight += in.weight ? n : 0;
      of.R += 9, of.bias += 3, of.residuals += 3 * n, of.cov += d * d, of.products += 18, of.numbers += 8;
    }
  };
  if (count * n < 1000) {
    run();
  } else {
    nb::gil_scoped_release released;
    run();
  }
  return nb::make_tuple(turn.array(), bias.array(), rest.array(), cov.array(), products.array(), told.array());
}

}  // namespace
}  // namespace armlab::python

void bind_weight(nb::module_ &m) {
  m.def("turned_weight", &armlab::python::turned_weight, armlab::array("R_base_tool"), armlab::array("force"),
        armlab::array("pull"), nb::arg("weight") = nb::none(), nb::arg("mass") = nb::none(), nb::arg("biased") = true);
}
