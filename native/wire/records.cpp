// Instances of a class with slots, without its __init__. Documented in armlab/kernels/_native.pyi.
#include <string>
#include <vector>

#include "array/arrays.h"

#include <structmember.h>  // after Python.h

namespace armlab {
namespace {

class RecordMaker {
 public:
  RecordMaker(nb::handle kind, nb::sequence names) : kind_(nb::borrow(kind)) {
    if (!PyType_Check(kind.ptr())) throw nb::type_error("Expected a class with slots.");
    for (nb::handle name : names) {
      const nb::object slot = nb::getattr(kind, name, nb::none());
      if (!PyObject_TypeCheck(slot.ptr(), &PyMemberDescr_Type))
        raise_shape_error(
            std::string("Expected slots of the class, got ") + nb::str(name).c_str() + ".");
      offsets_.push_back(reinterpret_cast<PyMemberDescrObject *>(slot.ptr())->d_member->offset);
    }
  }

  nb::object make(nb::tuple values) const {
    if (values.size() != offsets_.size())
      raise_shape_error("Expected one value for each of " + std::to_string(offsets_.size()) +
                        " slots, got " + std::to_string(values.size()) + ".");
    auto *type = reinterpret_cast<PyTypeObject *>(kind_.ptr());
    nb::object made = nb::steal(type->tp_alloc(type, 0));
    if (!made.is_valid()) throw nb::python_error();
    for (std::size_t k = 0; k < offsets_.size(); ++k)
      *reinterpret_cast<PyObject **>(reinterpret_cast<char *>(made.ptr()) + offsets_[k]) =
          nb::object(values[k]).release().ptr();
    return made;
  }

 private:
  nb::object kind_;
  std::vector<Py_ssize_t> offsets_;
};

}  // namespace
}  // namespace armlab

void bind_records(nb::module_ &m) {
  using armlab::RecordMaker;
  nb::class_<RecordMaker>(m, "RecordMaker", "See _native.pyi.")
      .def(nb::init<nb::handle, nb::sequence>(), nb::arg("kind"), nb::arg("names"))
      .def("make", &RecordMaker::make, nb::arg("values"));
}
