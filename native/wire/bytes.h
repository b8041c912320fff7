// Python bytes objects, and values in them.
#pragma once

#include "array/arrays.h"

namespace armlab {

inline std::string_view view(nb::handle bytes) {
  char *data;
  Py_ssize_t size;
  if (PyBytes_AsStringAndSize(bytes.ptr(), &data, &size) < 0) throw nb::python_error();
  return {data, static_cast<std::size_t>(size)};
}

template <class T>
T get(const void *from) {
  T value;
  std::memcpy(&value, from, sizeof value);
  return value;
}

template <class T>
void put(char *to, T value) {
  std::memcpy(to, &value, sizeof value);
}

}  // namespace armlab
