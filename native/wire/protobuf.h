// Sequential reader and writer of protobuf fields.
#pragma once

#include "wire/bytes.h"

namespace armlab::protobuf {

using Doubles = std::vector<double>;

constexpr std::size_t deepest = 100;  // nesting depth of groups
enum Kind { varint = 0, eight_bytes = 1, message = 2, group = 3, group_end = 4, four_bytes = 5 };

struct Field {
  std::uint32_t number;
  int kind;
  std::uint64_t integer;   // value of a varint
  std::string_view bytes;  // value of other kinds

  bool is_varint(std::uint32_t wanted) const { return number == wanted && kind == varint; }
};

// Reads the fields of one message in sequence.
class FieldReader {
 public:
  explicit FieldReader(std::string_view data) : at_(data.data()), end_(at_ + data.size()) {}

  bool is_malformed() const { return malformed_; }

  // Reads the next field; false at the end and for malformed input. Groups are skipped.
  bool next(Field &field) {
    while (at_ != end_) {
      if (!read(field)) return false;
      if (field.kind == group) {
        groups_.push_back(field.number);
        if (groups_.size() > deepest) return fail();
      } else if (field.kind == group_end) {
        if (groups_.empty() || groups_.back() != field.number) return fail();
        groups_.pop_back();
      } else if (groups_.empty()) {
        return true;
      }
    }
    return !groups_.empty() && fail();
  }

 private:
  bool fail() {
    malformed_ = true;
    return false;
  }

  bool read(Field &field) {
    std::uint64_t tag;
    if (!read_varint(tag, 5) || tag > 0xffffffff || tag >> 3 == 0) return fail();
    field.number = static_cast<std::uint32_t>(tag >> 3);
    field.kind = tag & 7;
    if (field.kind == varint) return read_varint(field.integer, 10) || fail();
    if (field.kind == group || field.kind == group_end) return true;
    std::uint64_t size = field.kind == eight_bytes ? 8 : 4;
    if (field.kind == message ? !read_varint(size, 10) : field.kind > four_bytes) return fail();
    if (size > static_cast<std::size_t>(end_ - at_)) return fail();
    field.bytes = {at_, static_cast<std::size_t>(size)};
    at_ += size;
    return true;
  }

  bool read_varint(std::uint64_t &value, int longest) {
    if (at_ != end_ && static_cast<unsigned char>(*at_) < 0x80) {
      value = static_cast<unsigned char>(*at_++);
      return true;
    }
    value = 0;
    for (int k = 0; k < longest && at_ != end_; ++k) {
      const auto byte = static_cast<unsigned char>(*at_++);
      value |= static_cast<std::uint64_t>(byte & 0x7f) << 7 * k;
      if (byte < 0x80) return true;
    }
    return false;
  }

  const char *at_, *end_;
  std::vector<std::uint32_t> groups_;
  bool malformed_ = false;
};

// Calls `take` for each field; it returns whether the field is well-formed.
template <class Take>
bool walk(std::string_view data, Take take) {
  FieldReader fields(data);
  Field field;
  while (fields.next(field))
    if (!take(field)) return false;
  return !fields.is_malformed();
}

inline bool is_well_formed(std::string_view data) {
  return walk(data, [](const Field &) { return true; });
}

// Appends a repeated double, packed or not.
inline bool append(const Field &field, Doubles &to) {
  if (field.kind != eight_bytes && field.kind != message) return true;
  if (field.bytes.size() % sizeof(double)) return false;
  const std::size_t count = to.size();
  to.resize(count + field.bytes.size() / sizeof(double));
  if (!field.bytes.empty()) std::memcpy(to.data() + count, field.bytes.data(), field.bytes.size());
  return true;
}

// Reads a message with one repeated double field, which controllers write unpacked.
inline bool read_doubles(std::string_view data, std::uint32_t number, Doubles &to) {
  constexpr std::size_t step = 1 + sizeof(double);
  while (data.size() >= step && data[0] == static_cast<char>(number << 3 | eight_bytes)) {
    to.push_back(get<double>(data.data() + 1));
    data.remove_prefix(step);
  }
  return data.empty() || walk(data, [&](const Field &field) {
    return field.number != number || append(field, to);
  });
}

// Reads a message of single doubles, numbered from 1.
inline bool read_numbers(std::string_view data, double *to, std::uint32_t count) {
  return walk(data, [&](const Field &field) {
    if (field.kind == eight_bytes && field.number <= count)
      to[field.number - 1] = get<double>(field.bytes.data());
    return true;
  });
}

// Appends a message to a buffer.
class FieldWriter {
 public:
  explicit FieldWriter(std::string &to) : to_(to) {}

  void integer(int number, std::uint64_t value) {
    number_of(number << 3 | varint);
    number_of(value);
  }
  void real(int number, double value) {
    char bytes[10 + sizeof value];
    const std::size_t tag = put(static_cast<std::uint64_t>(number) << 3 | eight_bytes, bytes);
    std::memcpy(bytes + tag, &value, sizeof value);
    to_.append(bytes, tag + sizeof value);
  }
  void packed(int number, const double *values, std::size_t count) {
    const auto *bytes = reinterpret_cast<const char *>(values);
    if (count) nested(number, [&] { to_.append(bytes, count * sizeof(double)); });
  }
  template <class Body>
  void nested(int number, Body body) {
    number_of(number << 3 | message);
    const std::size_t start = to_.size();
    body();
    std::uint64_t size = to_.size() - start;
    char length[10];
    to_.insert(start, length, put(size, length));
  }

 private:
  static std::size_t put(std::uint64_t value, char *to) {
    std::size_t count = 0;
    for (; value > 0x7f; value >>= 7) to[count++] = static_cast<char>(value | 0x80);
    to[count++] = static_cast<char>(value);
    return count;
  }
  void number_of(std::uint64_t value) {
    char bytes[10];
    to_.append(bytes, put(value, bytes));
  }

  std::string &to_;
};

}  // namespace armlab::protobuf
