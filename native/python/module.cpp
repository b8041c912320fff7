// The extension module armlab.kernels._native. Each topic binds its own kernels; this file only
// calls them.
#define ARMLAB_IMPORTS_NUMPY
#include "array/arrays.h"

#include <exception>
#include <typeinfo>

void bind_chain(nb::module_ &m);
void bind_datagrams(nb::module_ &m);
void bind_drive(nb::module_ &m);
void bind_egm(nb::module_ &m);
void bind_estimator(nb::module_ &m);
void bind_inverse(nb::module_ &m);
void bind_lie(nb::module_ &m);
void bind_limits(nb::module_ &m);
void bind_messages(nb::module_ &m);
void bind_momentum(nb::module_ &m);
void bind_obstacles(nb::module_ &m);
void bind_path(nb::module_ &m);
void bind_primitive(nb::module_ &m);
void bind_records(nb::module_ &m);
void bind_rotation_primitive(nb::module_ &m);
void bind_row_encoder(nb::module_ &m);
void bind_row_packer(nb::module_ &m);
void bind_signals(nb::module_ &m);
void bind_two_dof(nb::module_ &m);
void bind_wrench(nb::module_ &m);

NB_MODULE(_native, m) {
  if (PyArray_ImportNumPyAPI() < 0) throw nb::python_error();
  nb::register_exception_translator([](const std::exception_ptr &thrown, void *) {
    try {
      std::rethrow_exception(thrown);
    } catch (const std::bad_cast &) {  // an argument within a list or tuple
      PyErr_SetString(PyExc_TypeError,
          "Expected arguments of the types that the documentation names, got another.");
    }
  });
  nb::set_leak_warnings(false);  // a robot that a module keeps until the interpreter ends is no
                                 // leak, and nothing prints
  m.doc() = "Compiled kernels of armlab; armlab.kernels is their public face.";
  bind_chain(m);
  bind_datagrams(m);
  bind_drive(m);
  bind_egm(m);
  bind_estimator(m);
  bind_inverse(m);
  bind_lie(m);
  bind_limits(m);
  bind_messages(m);
  bind_momentum(m);
  bind_obstacles(m);
  bind_path(m);
  bind_primitive(m);
  bind_records(m);
  bind_rotation_primitive(m);
  bind_row_encoder(m);
  bind_row_packer(m);
  bind_signals(m);
  bind_two_dof(m);
  bind_wrench(m);
}
