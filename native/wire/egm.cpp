// EGM datagrams read and written where the numbers of one like them lay. Documented in armlab/kernels/_native.pyi.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <utility>
#include <array>
#include <string>
#include <string_view>
#include <tuple>
#include <vector>

#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "array/arrays.h"

namespace armlab {
namespace {

using Span = std::pair<int, int>;
using Cut = std::tuple<int, int, int>;
using Integers = std::array<std::uint64_t, 6>;  // seqno, tm, seconds, microseconds, monotonic clock, queue depth

constexpr int pose_numbers = 7, matrix_numbers = 16, after_scaled = pose_numbers + 1;
constexpr double most = 1e9;  // degrees or mm: no arm is there, and differences of larger ones would not be finite
constexpr std::uint64_t low_32 = 0xffffffff, max_seconds = 9'000'000'000, max_microseconds = 1'000'000'000;

// x, y, z [mm] and a quaternion to the rows of a matrix [m]; NaN for a quaternion without a usable norm.
void matrix_of(const double *pose, double *out) {
  const double a = pose[3], b = pose[4], c = pose[5], d = pose[6];
  const double norm = a * a + b * b + c * c + d * d;
  if (!(1e-12 < norm && norm < 1e12)) {
    std::fill_n(out, matrix_numbers, std::numeric_limits<double>::quiet_NaN());
    return;
  }
  const double s = 2.0 / norm;
  const double b2 = s * b * b, c2 = s * c * c, d2 = s * d * d, bc = s * b * c, bd = s * b * d, cd = s * c * d;
  const double ab = s * a * b, ac = s * a * c, ad = s * a * d;
  const double rows[matrix_numbers] = {1.0 - c2 - d2, bc - ad, bd + ac, 1e-3 * pose[0],  //
                                       bc + ad, 1.0 - b2 - d2, cd - ab, 1e-3 * pose[1],  //
                                       bd - ac, cd + ab, 1.0 - b2 - c2, 1e-3 * pose[2],  //
                                       0.0, 0.0, 0.0, 1.0};
  std::copy_n(rows, matrix_numbers, out);
}

std::string_view bytes_of(nb::handle value) {
  if (!PyBytes_Check(value.ptr())) throw nb::type_error("Expected the bytes of one datagram.");
  return {PyBytes_AS_STRING(value.ptr()), static_cast<std::size_t>(PyBytes_GET_SIZE(value.ptr()))};
}

bool lies_within(const std::vector<Span> &spans, std::size_t size) {
  return std::all_of(spans.begin(), spans.end(), [size](Span span) {
    return 0 <= span.first && span.first <= span.second && static_cast<std::size_t>(span.second) <= size;
  });
}

bool lies_within(const std::vector<int> &offsets, std::size_t size) {
  return std::all_of(offsets.begin(), offsets.end(),
                     [size](int at) { return at == -1 || (at >= 0 && at + sizeof(double) <= size); });
}

[[noreturn]] void refuse_layout() { raise_shape_error("Expected numbers that lie within the datagram, got others."); }

class EgmReader {
 public:
  EgmReader(nb::handle kind, nb::tuple fixed, std::vector<Cut> arrays, int matrix, std::vector<int> scalars,
            nb::handle scale, std::vector<Span> finite)
      : kind_(nb::borrow(kind)), fixed_(fixed), arrays_(std::move(arrays)), matrix_(matrix), finite_(std::move(finite)) {
    const Input factors(scale, "scale");
    scale_.assign(factors.data(), factors.data() + factors.size());
    const int fields = static_cast<int>(fixed.size());
    const auto is_field = [fields](int field, int least) { return field >= least && field < fields; };
    bool fits = PyType_Check(kind.ptr()) && PyType_IsSubtype(type(), &PyTuple_Type) && scalars.size() == scalars_.size() &&
                is_field(matrix, 0) && count() >= pose_numbers + 1;
    for (const auto &[field, start, stop] : arrays_)
      fits = fits && is_field(field, 0) && 0 <= start && start <= stop && stop <= count() - after_scaled;
    for (int field : scalars) fits = fits && is_field(field, -1);
    if (!fits || !lies_within(finite_, static_cast<std::size_t>(count())))
      raise_shape_error("Expected a named tuple, and fields and numbers of it, got others.");
    std::copy(scalars.begin(), scalars.end(), scalars_.begin());
  }

  void learn(nb::handle data, nb::handle mask, std::vector<int> offsets, std::vector<Span> spans) {
    const std::string_view bytes = bytes_of(data), bits = bytes_of(mask);
    if (bits.size() != bytes.size() || static_cast<int>(offsets.size()) != count() ||
        spans.size() != std::tuple_size_v<Integers> || !lies_within(offsets, bytes.size()) ||
        !lies_within(spans, bytes.size()))
      refuse_layout();
    const std::size_t words = (bytes.size() + 7) / 8;
    size_ = bytes.size();
    masks_.assign(words, 0), shape_.assign(words, 0);
    if (size_) {
      std::memcpy(masks_.data(), bits.data(), size_);
      std::memcpy(shape_.data(), bytes.data(), size_);
    }
    for (std::size_t k = 0; k < words; ++k) shape_[k] &= masks_[k];
    offsets_ = std::move(offsets), spans_ = std::move(spans);
  }

  nb::object read(nb::handle data) const {
    const std::string_view bytes = bytes_of(data);
    if (offsets_.empty() || bytes.size() != size_ || !looks_alike(bytes.data())) return nb::none();
    std::vector<double> numbers(static_cast<std::size_t>(count()), 0.0);
    for (int k = 0; k < count(); ++k)
      if (offsets_[k] >= 0) std::memcpy(numbers.data() + k, bytes.data() + offsets_[k], sizeof(double));
    Integers integers{};
    for (std::size_t k = 0; k < spans_.size(); ++k)
      for (int at = spans_[k].second - 1; at >= spans_[k].first; --at)
        integers[k] = integers[k] << 7 | (static_cast<unsigned char>(bytes[at]) & 0x7f);
    return made(numbers.data(), integers);
  }

  nb::object packet(const std::vector<double> &numbers, nb::sequence integers) const {
    Integers values{};
    if (static_cast<int>(numbers.size()) != count() || nb::len(integers) != values.size())
      raise_shape_error("Expected " + std::to_string(count()) + " numbers and 6 integers, got " +
                        std::to_string(numbers.size()) + " and " + std::to_string(nb::len(integers)) + ".");
    for (std::size_t k = 0; k < values.size(); ++k) {
      values[k] = PyLong_AsUnsignedLongLongMask(nb::object(integers[k]).ptr());
      if (PyErr_Occurred()) throw nb::python_error();
    }
    return made(numbers.data(), values);
  }

 private:
  PyTypeObject *type() const { return reinterpret_cast<PyTypeObject *>(kind_.ptr()); }
  int count() const { return static_cast<int>(scale_.size()) - matrix_numbers + after_scaled; }

  bool looks_alike(const char *data) const {
    const std::size_t whole = size_ / 8;
    std::uint64_t differs = 0, word = 0;
    for (std::size_t k = 0; k < whole; ++k) {
      std::memcpy(&word, data + 8 * k, 8);
      differs |= (word & masks_[k]) ^ shape_[k];
    }
    if (whole < masks_.size()) {
      word = 0;
      std::memcpy(&word, data + 8 * whole, size_ - 8 * whole);
      differs |= (word & masks_[whole]) ^ shape_[whole];
    }
    return !differs;
  }

  nb::object made(const double *numbers, const Integers &integers) const {
    for (const auto &[start, stop] : finite_)
      for (int k = start; k < stop; ++k)
        if (!(std::abs(numbers[k]) <= most)) return nb::none();
    const int scaled = count() - after_scaled;
    const npy_intp length = scaled + matrix_numbers;
    const nb::object values = fresh_array(1, &length);
    auto *array = reinterpret_cast<PyArrayObject *>(values.ptr());
    auto *data = static_cast<double *>(PyArray_DATA(array));
    for (int k = 0; k < scaled; ++k) data[k] = numbers[k] * scale_[k];
    matrix_of(numbers + scaled + 1, data + scaled);
    PyArray_CLEARFLAGS(array, NPY_ARRAY_WRITEABLE);

    nb::object out = nb::steal(type()->tp_alloc(type(), static_cast<Py_ssize_t>(fixed_.size())));
    if (!out.is_valid()) throw nb::python_error();
    const auto set = [&out](int field, nb::object value) {
      if (field >= 0) Py_XSETREF(reinterpret_cast<PyTupleObject *>(out.ptr())->ob_item[field], value.release().ptr());
    };
    for (std::size_t k = 0; k < fixed_.size(); ++k) set(static_cast<int>(k), nb::object(fixed_[k]));
    for (const auto &[field, start, stop] : arrays_) {
      const npy_intp shape[1] = {stop - start};
      set(field, part(values, data + start, 1, shape));
    }
    const npy_intp square[2] = {4, 4};
    set(matrix_, part(values, data + scaled, 2, square));
    const auto &[seqno, tm, seconds, microseconds, mono, queue] = integers;
    const bool counts = seconds < max_seconds && microseconds < max_microseconds;
    const std::uint64_t robot_ns = counts ? seconds * 1'000'000'000 + microseconds * 1000 : 0;
    set(scalars_[0], nb::int_(seqno & low_32));
    set(scalars_[1], nb::int_(tm & low_32));
    set(scalars_[2], nb::int_(robot_ns));
    set(scalars_[3], nb::float_(numbers[scaled]));
    set(scalars_[4], nb::int_(mono));
    set(scalars_[5], nb::int_(queue & low_32));
    return out;
  }

  // A read-only view of some of the values.
  static nb::object part(const nb::object &values, double *data, int ndim, const npy_intp *shape) {
    PyObject *view = PyArray_New(&PyArray_Type, ndim, shape, NPY_DOUBLE, nullptr, data, 0,
                                 NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_ALIGNED, nullptr);
    if (!view) throw nb::python_error();
    const nb::object owned = nb::steal(view);
    if (PyArray_SetBaseObject(reinterpret_cast<PyArrayObject *>(view), nb::object(values).release().ptr()) < 0)
      throw nb::python_error();
    return owned;
  }

  nb::object kind_;
  nb::tuple fixed_;
  std::vector<Cut> arrays_;
  int matrix_;
  std::array<int, 6> scalars_{};
  std::vector<double> scale_;
  std::vector<Span> finite_;
  std::size_t size_ = 0;
  std::vector<std::uint64_t> masks_, shape_;
  std::vector<int> offsets_;
  std::vector<Span> spans_;
};

class EgmWriter {
 public:
  EgmWriter(nb::handle example, std::vector<int> offsets, nb::handle divisors, std::vector<Span> spans)
      : example_(bytes_of(example)), offsets_(std::move(offsets)), spans_(std::move(spans)) {
    const Input factors(divisors, "divisors");
    factors.require_exactly({static_cast<npy_intp>(offsets_.size())});
    divisors_.assign(factors.data(), factors.data() + factors.size());
    if (!lies_within(offsets_, example_.size()) || !lies_within(spans_, example_.size())) refuse_layout();
  }

  nb::object write(nb::tuple arrays, nb::tuple integers) const {
    nb::object out = nb::steal(PyBytes_FromStringAndSize(example_.data(), static_cast<Py_ssize_t>(example_.size())));
    if (!out.is_valid()) throw nb::python_error();
    char *bytes = PyBytes_AS_STRING(out.ptr());
    std::size_t k = 0;
    for (nb::handle given : arrays) {
      const Input values(given, "values");
      const auto size = static_cast<std::size_t>(values.size());
      if (k + size > offsets_.size()) refuse(arrays, integers);
      for (std::size_t i = 0; i < size; ++i, ++k) {
        const double wire = values.data()[i] / divisors_[k];
        if (offsets_[k] >= 0) std::memcpy(bytes + offsets_[k], &wire, sizeof wire);
      }
    }
    if (k != offsets_.size() || integers.size() != spans_.size()) refuse(arrays, integers);
    for (k = 0; k < spans_.size(); ++k) {
      std::uint64_t left = PyLong_AsUnsignedLongLongMask(integers[k].ptr());
      if (PyErr_Occurred()) throw nb::python_error();
      for (int at = spans_[k].first; at < spans_[k].second; ++at, left >>= 7) {
        const bool last = at + 1 == spans_[k].second;
        if (last ? left > 0x7f : left <= 0x7f) return nb::none();  // it takes another number of bytes
        bytes[at] = static_cast<char>((left & 0x7f) | (last ? 0 : 0x80));
      }
    }
    return out;
  }

 private:
  [[noreturn]] void refuse(const nb::tuple &arrays, const nb::tuple &integers) const {
    raise_shape_error("Expected " + std::to_string(offsets_.size()) + " numbers and " + std::to_string(spans_.size()) +
                      " integers, got others in " + std::to_string(arrays.size()) + " arrays and " +
                      std::to_string(integers.size()) + " integers.");
  }

  std::string example_;
  std::vector<int> offsets_;
  std::vector<double> divisors_;
  std::vector<Span> spans_;
};

}  // namespace
}  // namespace armlab

void bind_egm(nb::module_ &m) {
  using armlab::array;
  using armlab::EgmReader;
  using armlab::EgmWriter;
  nb::class_<EgmReader>(m, "EgmReader", "See _native.pyi.")
      .def(nb::init<nb::handle, nb::tuple, std::vector<armlab::Cut>, int, std::vector<int>, nb::handle,
                    std::vector<armlab::Span>>(),
           nb::arg("kind"), nb::arg("fixed"), nb::arg("arrays"), nb::arg("matrix"), nb::arg("scalars"), array("scale"),
           nb::arg("finite"))
      .def("learn", &EgmReader::learn, nb::arg("data"), nb::arg("mask"), nb::arg("offsets"), nb::arg("spans"))
      .def("read", &EgmReader::read, nb::arg("data"))
      .def("packet", &EgmReader::packet, nb::arg("numbers"), nb::arg("integers"));
  nb::class_<EgmWriter>(m, "EgmWriter", "See _native.pyi.")
      .def(nb::init<nb::handle, std::vector<int>, nb::handle, std::vector<armlab::Span>>(), nb::arg("example"),
           nb::arg("offsets"), array("divisors"), nb::arg("spans"))
      .def("write", &EgmWriter::write, nb::arg("arrays"), nb::arg("integers"));
}
