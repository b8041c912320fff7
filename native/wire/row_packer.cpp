// Packing of recorded rows into bytes, and fast creation of frozen dataclasses. Documented in
// _native.pyi.
#include <iterator>

#include "wire/bytes.h"

#include <structmember.h>  // after Python.h

namespace armlab::python {
namespace {

enum Form {
  kCount,
  kReal,
  kFlag,
  kCode,
  kDoubles,
  kFitting,
  kPadded,
  kBits,
  kWide,
  kSaid,
  kHeard,
  kBlank
};
constexpr const char *kForms[] = {"count", "real", "flag", "code", "doubles", "fitting", "padded",
    "bits", "wide", "said", "heard", "blank"};

// The offset in bytes from an object to the pointer of an attribute that is a slot or a named-tuple
// item. -1 for other attributes, which are read by getattr.
std::int32_t offset_of(nb::handle kind, nb::handle name) {
  const nb::object found = nb::getattr(kind, name, nb::none());
  if (PyObject_TypeCheck(found.ptr(), &PyMemberDescr_Type))
    return static_cast<std::int32_t>(
        reinterpret_cast<PyMemberDescrObject *>(found.ptr())->d_member->offset);
  if (!PyType_IsSubtype(reinterpret_cast<PyTypeObject *>(kind.ptr()), &PyTuple_Type) ||
      !nb::hasattr(kind, "_fields"))
    return -1;
  const auto item = nb::cast<std::int32_t>(kind.attr("_fields").attr("index")(name));
  return static_cast<std::int32_t>(offsetof(PyTupleObject, ob_item) + item * sizeof(PyObject *));
}

// Per-cycle data of one field: small, because caches are cold after a sleep.
struct Place {
  std::int32_t offset;
  std::uint32_t start, size;
  std::int16_t heard;   // for "heard": index of the place that reports it
  std::uint8_t source;  // 0 state, 1 command, 2 tick, 3 record
  std::uint8_t form;
};

// Rarely needed data.
struct About {
  std::string column;
  nb::object field, codes;
};

double real(nb::handle value) {
  const double number = PyFloat_AsDouble(value.ptr());
  if (number == -1.0 && PyErr_Occurred()) throw nb::python_error();
  return number;
}

std::int64_t whole(nb::handle value) {
  const nb::object number = nb::steal(PyNumber_Index(value.ptr()));
  if (!number.is_valid()) throw nb::python_error();
  const long long found = PyLong_AsLongLong(number.ptr());
  if (found == -1 && PyErr_Occurred()) throw nb::python_error();
  return found;
}

bool truth(nb::handle value) {
  const int found = PyObject_IsTrue(value.ptr());
  if (found < 0) throw nb::python_error();
  return found != 0;
}

std::int64_t code(const nb::object &codes, nb::handle text) {
  PyObject *found = PyDict_GetItemWithError(codes.ptr(), text.ptr());
  if (!found && PyErr_Occurred()) throw nb::python_error();
  return found ? whole(found) : 0;
}

// Returns a mapping as a dict, or None if it is empty.
nb::object dict(nb::object record) {
  if (PyDict_CheckExact(record.ptr())) return record;
  const Py_ssize_t size = PyMapping_Size(record.ptr());
  if (size < 0) throw nb::python_error();
  if (size == 0) return nb::object();
  nb::object made = nb::steal(PyDict_New());
  if (!made.is_valid() || PyDict_Update(made.ptr(), record.ptr()) < 0) throw nb::python_error();
  return made;
}

// Returns a contiguous numpy.asarray(value, dtype).
nb::object plain(nb::handle value, int type) {
  if (PyArray_CheckExact(value.ptr())) {
    PyArrayObject *array = as_array(value);
    if (PyArray_TYPE(array) == type && PyArray_IS_C_CONTIGUOUS(array) &&
        PyArray_ISNOTSWAPPED(array))
      return nb::borrow(value);
  }
  PyObject *made =
      PyArray_FROMANY(value.ptr(), type, 0, 0, NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_FORCECAST);
  if (!made) throw nb::python_error();
  return nb::steal(made);
}

class RowPacker {
 public:
  RowPacker(nb::tuple kinds, nb::sequence places, nb::str seldom)
      : record_(nb::str("record")), kinds_(kinds) {
    for (nb::handle each : places) {
      add(nb::cast<nb::tuple>(each));
      if (abouts_.back().column == seldom.c_str()) short_ = places_.back().start;
    }
    short_ = std::min(short_, empty_.size());
    command_record_ = offset_of(kinds[1], record_);
    tick_record_ = offset_of(kinds[2], record_);
  }

  nb::bytes pack(nb::handle state, nb::handle command, nb::handle tick) const {
    Source sources[] = {{state}, {command}, {tick}};
    for (int k = 0; k < 3; ++k) {
      auto *kind = reinterpret_cast<PyTypeObject *>(PyTuple_GET_ITEM(kinds_.ptr(), k));
      sources[k].is_known = PyObject_TypeCheck(sources[k].owner.ptr(), kind);
    }
    nb::object records[2];
    if (!command.is_none()) records[0] = dict(attribute(sources[1], command_record_, record_));
    records[1] = dict(attribute(sources[2], tick_record_, record_));
    std::string row = empty_;
    for (std::size_t k = 0; k < places_.size(); ++k) {
      const Place &place = places_[k];
      if (place.form == kBlank) continue;
      if (place.source == 3) {
        const nb::object value = recorded(records, abouts_[k].field);
        if (value.is_valid()) write(k, value, row);
      } else if (place.source != 1 || !command.is_none()) {
        write(k, attribute(sources[place.source], place.offset, abouts_[k].field), row);
      }
    }
    const bool ends =
        row.compare(short_, std::string::npos, empty_, short_, std::string::npos) == 0;
    return nb::bytes(row.data(), ends ? short_ : row.size());
  }

 private:
  struct Source {
    nb::handle owner;
    bool is_known = false;  // whether the offsets apply to its class
  };

  static nb::object attribute(const Source &source, std::int32_t offset, const nb::object &name) {
    if (source.is_known && offset >= 0)
      if (auto *value =
              *reinterpret_cast<PyObject **>(reinterpret_cast<char *>(source.owner.ptr()) + offset))
        return nb::borrow(value);
    PyObject *value = PyObject_GetAttr(source.owner.ptr(), name.ptr());
    if (!value) throw nb::python_error();
    return nb::steal(value);
  }

  static nb::object recorded(const nb::object (&records)[2], const nb::object &name) {
    for (const nb::object &record : records) {
      if (!record.is_valid()) continue;
      PyObject *value = PyDict_GetItemWithError(record.ptr(), name.ptr());
      if (!value && PyErr_Occurred()) throw nb::python_error();
      if (value) return nb::borrow(value);
    }
    return nb::object();
  }

  void add(const nb::tuple &given) {
    static constexpr const char *kSources[] = {"state", "command", "tick", "record"};
    const std::string source = nb::cast<nb::str>(given[1]).c_str(),
                      form = nb::cast<nb::str>(given[3]).c_str();
    About about{nb::cast<nb::str>(given[0]).c_str(), given[2], given[5]};
    const auto found = std::find(std::begin(kForms), std::end(kForms), form);
    if (found == std::end(kForms)) {
      std::string all;
      for (const char *one : kForms) all += (all.empty() ? "" : ", ") + std::string(one);
      raise_shape_error(
          "Expected one of the forms " + all + " for " + about.column + ", got " + form + ".");
    }
    const auto nothing = nb::cast<nb::bytes>(given[4]);
    const auto origin =
        std::find(std::begin(kSources), std::end(kSources), source) - std::begin(kSources);
    Place place{-1, static_cast<std::uint32_t>(empty_.size()),
        static_cast<std::uint32_t>(nothing.size()), -1, static_cast<std::uint8_t>(origin),
        static_cast<std::uint8_t>(found - std::begin(kForms))};
    const bool is_single = place.form == kCount || place.form == kReal || place.form == kCode ||
                           place.form == kSaid || place.form == kHeard;
    if (place.source == 4 || (is_single && place.size != 8) ||
        (place.form == kFlag && place.size != 1 && place.size != 8) ||
        (place.form == kCode && !PyDict_Check(about.codes.ptr())))
      raise_shape_error("Expected a source, a size and codes that fit the form " + form + " for " +
                        about.column + ".");
    if (place.source < 3 && place.form != kBlank)
      place.offset = offset_of(kinds_[place.source], about.field);
    if (place.form == kHeard) {
      const std::string data = nb::cast<nb::str>(given[5]).c_str();
      for (std::size_t k = 0; k < places_.size(); ++k)
        if (abouts_[k].column == data) place.heard = static_cast<std::int16_t>(k);
      if (place.heard < 0)
        raise_shape_error("Expected the data column before " + about.column + ".");
    }
    empty_.append(nothing.c_str(), nothing.size());
    places_.push_back(place);
    abouts_.push_back(std::move(about));
  }

  void write(std::size_t k, nb::handle value, std::string &row) const {
    const Place &place = places_[k];
    char *to = row.data() + place.start;
    if (place.form == kCount) return put(to, whole(value));
    if (place.form == kReal) return put(to, real(value));
    if (place.form == kCode) return put(to, code(abouts_[k].codes, value));
    if (place.form == kFlag && place.size == 1) return put<char>(to, truth(value));
    if (place.form == kFlag) return put<std::int64_t>(to, truth(value));
    if (place.form == kHeard) {
      const Place &other = places_[place.heard];
      const bool heard = truth(value);
      if (heard || row.compare(other.start, other.size, empty_, other.start, other.size) != 0)
        put(to, heard ? 1.0 : 0.0);
      return;
    }
    if (value.is_none()) return;
    if (place.form == kSaid) put(to, real(value));
    else write_array(k, value, to);
  }

  void write_array(std::size_t k, nb::handle value, char *to) const {
    const Place &place = places_[k];
    if (place.form == kBits || place.form == kWide) return write_bits(k, value, to);
    nb::object held;
    try {
      held = plain(value, NPY_DOUBLE);
    } catch (nb::python_error &error) {
      const bool is_no_array = error.matches(PyExc_ValueError) || error.matches(PyExc_TypeError);
      if (place.form == kFitting && is_no_array) return;
      throw;
    }
    PyArrayObject *array = as_array(held);
    const std::size_t bytes = static_cast<std::size_t>(PyArray_NBYTES(array));
    if (place.form == kPadded) {
      std::memcpy(to, PyArray_DATA(array), std::min<std::size_t>(bytes, place.size));
    } else if (bytes == place.size) {
      std::memcpy(to, PyArray_DATA(array), bytes);
    } else if (bytes != 0 && place.form != kFitting) {
      refuse(k, place.size / sizeof(double), array);
    }
  }

  void write_bits(std::size_t k, nb::handle value, char *to) const {
    const nb::object held = plain(value, NPY_UINT8);
    PyArrayObject *array = as_array(held);
    const auto count = static_cast<std::size_t>(PyArray_SIZE(array));
    const auto *bits = static_cast<const std::uint8_t *>(PyArray_DATA(array));
    const std::size_t size = places_[k].size, width = places_[k].form == kWide ? 8 : 1;
    if (width * count != size) refuse(k, size / width, array);
    if (width == 1) std::memcpy(to, bits, count);
    else
      for (std::size_t i = 0; i < count; ++i) put<std::int64_t>(to + 8 * i, bits[i]);
  }

  [[noreturn]] void refuse(std::size_t k, std::size_t wanted, PyArrayObject *array) const {
    raise_shape_error("Expected " + std::to_string(wanted) + " values in " + abouts_[k].column +
                      ", got " + std::to_string(PyArray_SIZE(array)) + ".");
  }

  nb::str record_;
  nb::tuple kinds_;
  std::int32_t command_record_ = -1, tick_record_ = -1;
  std::vector<Place> places_;
  std::vector<About> abouts_;
  std::string empty_;
  std::size_t short_ = std::string::npos;
};

// Sets each slot as object.__setattr__ would, in a tenth of the time of a frozen dataclass's
// constructor.
nb::object filled(nb::handle kind, nb::tuple slots, nb::tuple values) {
  if (!PyType_Check(kind.ptr()) || slots.size() != values.size())
    throw nb::type_error("Expected a class, its slots and one value per slot.");
  auto *type = reinterpret_cast<PyTypeObject *>(kind.ptr());
  const nb::object made = nb::steal(type->tp_alloc(type, 0));
  if (!made.is_valid()) throw nb::python_error();
  for (std::size_t k = 0; k < slots.size(); ++k) {
    const nb::handle slot = slots[k];
    if (!PyObject_TypeCheck(slot.ptr(), &PyMemberDescr_Type))
      throw nb::type_error("Expected slot descriptors of the class.");
    if (Py_TYPE(slot.ptr())->tp_descr_set(slot.ptr(), made.ptr(), nb::handle(values[k]).ptr()))
      throw nb::python_error();
  }
  return made;
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_row_packer(nb::module_ &m) {
  nb::class_<RowPacker>(m, "RowPacker", "See _native.pyi.")
      .def(nb::init<nb::tuple, nb::sequence, nb::str>(), arg("kinds"), arg("places"), arg("seldom"))
      .def(
          "pack", &RowPacker::pack, arg("state").none(), arg("command").none(), arg("tick").none());
  m.def("filled", &filled, arg("kind"), arg("slots"), arg("values"), "See _native.pyi.");
}
