// Text of JSON with numbers out of packed bytes. Documented in armlab/kernels/_native.pyi.
#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>
#include <vector>

#include "array/arrays.h"
#include "wire/bytes.h"

namespace armlab {
namespace {

constexpr std::size_t longest = 32;  // characters of a number: -2.2250738585072014e-308 has 24

char *write(char *to, std::string_view text) { return std::copy(text.begin(), text.end(), to); }

template <class T>
char *write_integer(char *to, const char *from) {
  return std::to_chars(to, to + longest, get<T>(from)).ptr;
}

char *write_real(char *to, double value) {
  if (!std::isfinite(value)) return write(to, "null");
  char *end = std::to_chars(to, to + longest, value).ptr;
  const bool is_real = std::any_of(to, end, [](char one) { return one == '.' || one == 'e'; });
  return is_real ? end : write(end, ".0");
}

std::size_t size_of(char form) {
  switch (form) {
    case '?': case 'b': case 'B': return 1;
    case 'h': case 'H': return 2;
    case 'i': case 'I': case 'f': return 4;
    case 'q': case 'Q': case 'd': case 't': return 8;
    default: return 0;
  }
}

char *write_number(char *to, char form, const char *from) {
  switch (form) {
    case '?': return write(to, *from ? "true" : "false");
    case 'b': return write_integer<std::int8_t>(to, from);
    case 'B': return write_integer<std::uint8_t>(to, from);
    case 'h': return write_integer<std::int16_t>(to, from);
    case 'H': return write_integer<std::uint16_t>(to, from);
    case 'i': return write_integer<std::int32_t>(to, from);
    case 'I': return write_integer<std::uint32_t>(to, from);
    case 'q': return write_integer<std::int64_t>(to, from);
    case 'Q': return write_integer<std::uint64_t>(to, from);
    case 'f': return write_real(to, get<float>(from));
    case 't': return write_real(to, 1e-9 * static_cast<double>(get<std::int64_t>(from)));
    default: return write_real(to, get<double>(from));
  }
}

struct Slot {
  std::size_t at;
  char form;
  std::string before;
};

class JsonText {
 public:
  JsonText(nb::sequence parts, nb::sequence slots) {
    if (nb::len(parts) != nb::len(slots) + 1) raise_shape_error("Expected one part of text more than slots, got others.");
    for (std::size_t k = 0; k < nb::len(slots); ++k) {
      const auto slot = nb::cast<nb::tuple>(slots[k]);
      const auto at = nb::cast<std::int64_t>(slot[0]);
      const std::string_view form = view(slot[1]);
      if (at < 0 || at >= std::int64_t{1} << 32 || form.size() != 1 || !size_of(form[0]))
        raise_shape_error("Expected slots (place, form) with a form of ?bBhHiIqQfdt, got another.");
      slots_.push_back({static_cast<std::size_t>(at), form[0], std::string(view(parts[k]))});
      needed_ = std::max(needed_, slots_.back().at + size_of(form[0]));
      room_ += slots_.back().before.size() + longest;
    }
    after_ = view(parts[slots_.size()]);
    room_ += after_.size();
  }

  nb::object of(nb::bytes data_) const {
    const std::string_view data = view(data_);
    if (data.size() < needed_)
      raise_shape_error("Expected at least " + std::to_string(needed_) + " bytes, got " + std::to_string(data.size()) + ".");
    PyObject *made = PyBytes_FromStringAndSize(nullptr, static_cast<Py_ssize_t>(room_));
    if (!made) throw nb::python_error();
    char *const begin = PyBytes_AS_STRING(made), *to = begin;
    for (const Slot &slot : slots_) to = write_number(write(to, slot.before), slot.form, data.data() + slot.at);
    to = write(to, after_);
    if (_PyBytes_Resize(&made, to - begin) < 0) throw nb::python_error();
    return nb::steal(made);
  }

 private:
  std::vector<Slot> slots_;
  std::string after_;
  std::size_t needed_ = 0, room_ = 0;
};

}  // namespace
}  // namespace armlab

void bind_json_text(nb::module_ &m) {
  using armlab::JsonText;
  nb::class_<JsonText>(m, "JsonText", "See _native.pyi.")
      .def(nb::init<nb::sequence, nb::sequence>(), nb::arg("parts"), nb::arg("slots"))
      .def("of", &JsonText::of, nb::arg("data"));
}
