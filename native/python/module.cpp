// The extension module armlab.kernels._native.
#define ARMLAB_IMPORTS_NUMPY
#include "array/arrays.h"

#include <typeinfo>

NB_MODULE(_native, m) {
  if (PyArray_ImportNumPyAPI() < 0) throw nb::python_error();
  nb::register_exception_translator([](const std::exception_ptr &thrown, void *) {
    try {
      std::rethrow_exception(thrown);
    } catch (const std::bad_cast &) {  // an argument within a list or tuple
      PyErr_SetString(
          PyExc_TypeError, "Expected arguments of the documented types, got another type.");
    }
  });
  nb::set_leak_warnings(false);  // a robot held by a module until exit is not a leak
  m.doc() = "Compiled kernels of armlab; use them through armlab.kernels.";
#define ARMLAB_BIND(topic) armlab::python::bind_##topic(m);
  ARMLAB_TOPICS(ARMLAB_BIND)
}
