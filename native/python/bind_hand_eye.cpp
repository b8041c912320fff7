// Python function hand_eye_rows; the mathematics is in hand_eye.h.
#include "math/lie/hand_eye.h"

#include "array/arrays.h"

namespace armlab::python {
namespace {

nb::object hand_eye_rows(nb::handle R_A_, nb::handle t_A_, nb::handle R_B_, nb::handle t_B_, nb::handle R_X_,
                         nb::handle t_X_, nb::handle R_Y_, nb::handle t_Y_) {
  Elements R_A(R_A_, "R_A", {3, 3}), t_A(t_A_, "t_A", {3}), R_B(R_B_, "R_B", {3, 3}), t_B(t_B_, "t_B", {3});
  Elements::broadcast({&R_A, &t_A, &R_B, &t_B});
  const Input R_X(R_X_, "R_X"), t_X(t_X_, "t_X"), R_Y(R_Y_, "R_Y"), t_Y(t_Y_, "t_Y");
  for (const Input *R : {&R_X, &R_Y}) R->require_exactly({3, 3});
  for (const Input *t : {&t_X, &t_Y}) t->require_exactly({3});
  const nb::none fresh;
  const Output r(fresh, "r", {6}, {&R_A}), J(fresh, "J", {6, 12}, {&R_A});
  const double *x = R_X.data(), *tx = t_X.data(), *y = R_Y.data(), *ty = t_Y.data();
  compute<4, 2>(R_A, {R_A.samples(), t_A.samples(), R_B.samples(), t_B.samples()}, {r.samples(), J.samples()},
                [=](const auto &in, const auto &out) {
                  armlab::hand_eye_rows(in[0], in[1], in[2], in[3], x, tx, y, ty, out[0], out[1]);
                });
  return nb::make_tuple(r.array(), J.array());
}

}  // namespace
}  // namespace armlab::python

void bind_hand_eye(nb::module_ &m) {
  using armlab::array;
  m.def("hand_eye_rows", &armlab::python::hand_eye_rows, array("R_A"), array("t_A"), array("R_B"), array("t_B"),
        array("R_X"), array("t_X"), array("R_Y"), array("t_Y"));
}
