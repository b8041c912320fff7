// Numeric fields of messages in a chunk of an MCAP file. Documented in _native.pyi.
#include <utility>

#include "wire/bytes.h"

#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

namespace armlab::python {
namespace {

constexpr std::size_t record_head = 9, message_head = 22;  // with channel, sequence, two times
constexpr std::uint8_t message_kind = 5;

struct Place {
  std::size_t start, stop;
};

// Returns a writable array of `rows` rows of `width` bytes; negative `rows`: any number of rows.
std::uint8_t *writable(nb::handle array, npy_intp rows, std::size_t width) {
  PyArrayObject *found = as_array(array);
  if (!PyArray_Check(array.ptr()) ||
      !PyArray_CHKFLAGS(found, NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_WRITEABLE) ||
      PyArray_NDIM(found) < 1 || (rows >= 0 && PyArray_DIM(found, 0) != rows) ||
      static_cast<std::size_t>(PyArray_NBYTES(found)) !=
          static_cast<std::size_t>(PyArray_DIM(found, 0)) * width)
    raise_shape_error("Expected writable arrays with a row of " + std::to_string(width) +
                      " bytes for every message, got another array.");
  return static_cast<std::uint8_t *>(PyArray_DATA(found));
}

// Pairs (k, 2) of start and stop positions within `size` bytes.
std::vector<Place> places_of(nb::handle pairs, std::size_t size) {
  std::vector<Place> places;
  for (nb::handle pair : pairs) {
    const auto [start, stop] = nb::cast<std::pair<std::int64_t, std::int64_t>>(pair);
    if (start < 0 || stop < start || static_cast<std::uint64_t>(stop) > size)
      raise_shape_error("Expected places in a message of " + std::to_string(size) + " bytes, got " +
                        std::to_string(start) + " to " + std::to_string(stop) + ".");
    places.push_back({static_cast<std::size_t>(start), static_cast<std::size_t>(stop)});
  }
  return places;
}

// The bytes of an object, kept alive by this instance.
class Bytes {
 public:
  explicit Bytes(nb::handle object) {
    if (PyObject_GetBuffer(object.ptr(), &buffer_, PyBUF_SIMPLE) != 0) throw nb::python_error();
  }
  Bytes(const Bytes &) = delete;
  Bytes &operator=(const Bytes &) = delete;
  ~Bytes() { PyBuffer_Release(&buffer_); }

  const std::uint8_t *data() const { return static_cast<const std::uint8_t *>(buffer_.buf); }
  std::size_t size() const { return static_cast<std::size_t>(buffer_.len); }

 private:
  Py_buffer buffer_;
};

struct Channel {
  std::uint16_t number;
  npy_intp rows;
  std::vector<std::uint8_t> example;
  std::vector<Place> fixed, places;
  std::uint8_t *sequence, *log_ns;
  std::vector<std::uint8_t *> columns;

  bool matches(const std::uint8_t *message, std::size_t length) const {
    if (length != example.size()) return false;
    for (const Place &place : fixed)
      if (std::memcmp(
              message + place.start, example.data() + place.start, place.stop - place.start) != 0)
        return false;
    return true;
  }
};

// Copies the rows of one column. Most numbers are doubles, which are copied in one instruction.
void copy_column(const std::vector<const std::uint8_t *> &records, std::size_t at,
    std::size_t width, std::uint8_t *to) {
  if (width % 8 != 0) {
    for (const std::uint8_t *record : records) std::memcpy(to, record + at, width), to += width;
    return;
  }
  for (const std::uint8_t *record : records)
    for (std::size_t byte = 0; byte < width; byte += 8, to += 8)
      std::memcpy(to, record + at + byte, 8);
}

class MessageCopier {
 public:
  explicit MessageCopier(nb::sequence channels) : slots_(1 << 16, -1) {
    for (nb::handle entry : channels) {
      const nb::tuple given = nb::cast<nb::tuple>(entry);
      if (given.size() != 7)
        raise_shape_error(
            "Expected seven entries for a channel, got " + std::to_string(given.size()) + ".");
      const nb::bytes example = nb::cast<nb::bytes>(given[1]);
      Channel channel;
      channel.number = nb::cast<std::uint16_t>(given[0]);
      const auto *bytes = reinterpret_cast<const std::uint8_t *>(example.c_str());
      channel.example.assign(bytes, bytes + example.size());
      channel.fixed = places_of(given[2], example.size());
      channel.places = places_of(given[3], example.size());
      channel.sequence = writable(given[4], -1, 4);
      channel.rows = PyArray_DIM(as_array(given[4]), 0);
      channel.log_ns = writable(given[5], channel.rows, 8);
      const nb::list columns(given[6]);
      if (columns.size() != channel.places.size())
        raise_shape_error("Expected an array for each of " + std::to_string(channel.places.size()) +
                          " places, got " + std::to_string(columns.size()) + ".");
      for (std::size_t k = 0; k < columns.size(); ++k)
        channel.columns.push_back(
            writable(columns[k], channel.rows, channel.places[k].stop - channel.places[k].start));
      slots_[channel.number] = static_cast<int>(channels_.size());
      channels_.push_back(std::move(channel));
      kept_.push_back(given);
    }
  }

  nb::list copy(nb::handle data, const std::vector<std::int64_t> &first,
      const std::vector<std::int64_t> &count) const {
    if (first.size() != channels_.size() || count.size() != channels_.size())
      raise_shape_error("Expected a first row and a count for each of " +
                        std::to_string(channels_.size()) + " channels.");
    for (std::size_t c = 0; c < channels_.size(); ++c)
      if (count[c] >= 0 &&
          (first[c] < 0 || first[c] > channels_[c].rows || count[c] > channels_[c].rows - first[c]))
        raise_shape_error("Expected rows from 0 to " + std::to_string(channels_[c].rows) +
                          ", got " + std::to_string(count[c]) + " from " +
                          std::to_string(first[c]) + ".");
    const Bytes bytes(data);
    std::vector<char> copied;
    {
      nb::gil_scoped_release released;
      copied = copy_all(bytes.data(), bytes.size(), first, count);
    }
    nb::list result;
    for (const char one : copied) result.append(one != 0);
    return result;
  }

 private:
  std::vector<char> copy_all(const std::uint8_t *data, std::size_t size,
      const std::vector<std::int64_t> &first, const std::vector<std::int64_t> &count) const {
    std::vector<std::vector<const std::uint8_t *>> records(channels_.size());
    std::vector<char> fits(channels_.size());
    for (std::size_t c = 0; c < channels_.size(); ++c) {
      fits[c] = count[c] >= 0;
      if (fits[c])
        records[c].reserve(
            std::min(static_cast<std::size_t>(count[c]), size / (record_head + message_head)));
    }
    for (std::size_t at = 0; size - at >= record_head;) {
      const std::uint8_t *record = data + at;
      const std::uint64_t length = get<std::uint64_t>(record + 1);
      if (length > size - at - record_head) break;
      at += record_head + length;
      if (*record != message_kind || length < message_head) continue;
      const int c = slots_[get<std::uint16_t>(record + record_head)];
      if (c < 0 || !fits[c]) continue;
      fits[c] = static_cast<std::int64_t>(records[c].size()) < count[c] &&
                channels_[c].matches(record + record_head + message_head, length - message_head);
      if (fits[c]) records[c].push_back(record);
    }
    for (std::size_t c = 0; c < channels_.size(); ++c) {
      fits[c] = fits[c] && static_cast<std::int64_t>(records[c].size()) == count[c];
      if (!fits[c]) continue;
      const Channel &channel = channels_[c];
      copy_column(records[c], record_head + 2, 4, channel.sequence + 4 * first[c]);
      copy_column(records[c], record_head + 6, 8, channel.log_ns + 8 * first[c]);
      for (std::size_t k = 0; k < channel.places.size(); ++k) {
        const std::size_t start = channel.places[k].start, width = channel.places[k].stop - start;
        copy_column(records[c], record_head + message_head + start, width,
            channel.columns[k] + width * first[c]);
      }
    }
    return fits;
  }

  std::vector<Channel> channels_;
  std::vector<int> slots_;       // index by channel number; -1 for other channels
  std::vector<nb::tuple> kept_;  // keeps the output arrays alive
};

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_messages(nb::module_ &m) {
  nb::class_<MessageCopier>(m, "MessageCopier", "See _native.pyi.")
      .def(nb::init<nb::sequence>(), arg("channels"))
      .def("copy", &MessageCopier::copy, arg("data"), arg("first"), arg("count"));
}
