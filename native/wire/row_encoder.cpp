// Encoder of recorded rows as MCAP records. Documented in armlab/kernels/_native.pyi.
#include <optional>

#include "wire/bytes.h"

#include <nanobind/stl/optional.h>

namespace armlab::python {
namespace {

constexpr std::size_t kHead = 31;  // opcode, length, channel, sequence, log and publish time
constexpr std::size_t kSequence = 11, kLogTime = 15, kPublishTime = 23, kStamp = kHead + 4;
constexpr std::size_t kMatrix = 16 * sizeof(double), kPose = 7 * sizeof(double), kShortest = 16;
constexpr std::int64_t kSecond = 1'000'000'000;
constexpr std::size_t kWorthReleasing = 32;  // rows; below it, releasing the GIL costs more

struct Copy {
  std::size_t to, from, count;
};

struct Column {
  std::size_t start;
  std::string nothing;
  bool optional;

  bool is_in(std::string_view row) const {
    return start < row.size() && row.substr(start, nothing.size()) != nothing;
  }
};

struct Variant {
  std::string record;  // record head and message
  std::vector<Copy> copies;
  std::size_t needs = 0;  // required bytes of a row
};

struct Topic {
  std::uint16_t channel;
  bool always, is_pose;
  std::vector<Column> columns;
  std::vector<Variant> variants;
};

// Writes position xyz and quaternion xyzw (w >= 0) of a homogeneous matrix.
void write_pose(const char *from, char *to) {
  double r[16];
  std::memcpy(r, from, sizeof r);
  // Shepperd's method: divide by the largest of the four components.
  const double squares[] = {
      r[0] - r[5] - r[10], r[5] - r[0] - r[10], r[10] - r[0] - r[5], r[0] + r[5] + r[10]};
  int largest = 0;
  for (int k = 1; k < 4; ++k)
    if (squares[k] > squares[largest]) largest = k;
  const double big = std::sqrt(1.0 + squares[largest]) / 2.0, s = 0.25 / big;
  const double xy = (r[4] + r[1]) * s, xz = (r[8] + r[2]) * s, yz = (r[9] + r[6]) * s;
  const double xw = (r[9] - r[6]) * s, yw = (r[2] - r[8]) * s, zw = (r[4] - r[1]) * s;
  const double all[4][4] = {
      {big, xy, xz, xw}, {xy, big, yz, yw}, {xz, yz, big, zw}, {xw, yw, zw, big}};
  const double sign = all[largest][3] < 0.0 ? -1.0 : 1.0;
  double pose[7] = {r[3], r[7], r[11]};
  for (int k = 0; k < 4; ++k) pose[3 + k] = sign * all[largest][k];
  std::memcpy(to, pose, sizeof pose);
}

[[noreturn]] void raise_too_short(std::size_t needs, std::size_t size) {
  raise_shape_error("Expected a row of " + std::to_string(needs) + " bytes or more, got " +
                    std::to_string(size) + ".");
}

class RowEncoder {
 public:
  explicit RowEncoder(nb::sequence topics) {
    for (nb::handle each : topics) topics_.push_back(topic(nb::cast<nb::tuple>(each)));
  }

  nb::tuple encode(nb::list rows, std::optional<std::int64_t> first, std::uint64_t at) const {
    if (rows.size() == 0) raise_shape_error("Expected at least one row, got none.");
    std::vector<nb::bytes> held;  // keeps the bytes alive
    std::vector<std::string_view> views;
    for (nb::handle row : rows) views.push_back(view(held.emplace_back(nb::cast<nb::bytes>(row))));
    Made made{{}, std::vector<std::string>(topics_.size()), 0, 0, 0, 0};
    if (views.size() < kWorthReleasing) {
      write_all(views, first, at, made);
    } else {
      nb::gil_scoped_release released;
      write_all(views, first, at, made);
    }
    if (made.needs) raise_too_short(made.needs, made.got);
    nb::dict entries;
    for (std::size_t k = 0; k < topics_.size(); ++k)
      if (!made.entries[k].empty())
        entries[nb::int_(topics_[k].channel)] =
            nb::bytes(made.entries[k].data(), made.entries[k].size());
    return nb::make_tuple(
        nb::bytes(made.data.data(), made.data.size()), entries, made.earliest, made.latest);
  }

 private:
  struct Made {
    std::string data;
    std::vector<std::string> entries;
    std::int64_t earliest, latest;
    std::size_t needs, got;  // needed and actual bytes of a row that is too short
  };

  static Topic topic(const nb::tuple &given) {
    Topic made{nb::cast<std::uint16_t>(given[0]), nb::cast<bool>(given[1]),
        nb::cast<bool>(given[4]), {}, {}};
    std::size_t sets = 1;
    for (nb::handle column : given[2]) {
      made.columns.push_back({nb::cast<std::size_t>(column[0]), std::string(view(column[1])),
          nb::cast<bool>(column[2])});
      sets <<= made.columns.back().optional;
    }
    for (nb::handle variant : given[3]) made.variants.push_back(template_of(variant, made));
    if (made.variants.size() != sets)
      raise_shape_error("Expected a template for each set of optional columns, got " +
                        std::to_string(made.variants.size()) + ".");
    return made;
  }

  static Variant template_of(nb::handle given, const Topic &topic) {
    const std::string message(view(given[0]));
    Variant made{std::string(kHead, '\0') + message, {}, 0};
    made.record[0] = 5;
    put<std::uint64_t>(&made.record[1], kHead - 9 + message.size());
    put(&made.record[9], topic.channel);
    bool fits = message.size() >= 12;
    for (nb::handle copy : given[1]) {
      const auto to = nb::cast<std::int64_t>(copy[0]), from = nb::cast<std::int64_t>(copy[1]);
      const auto count = nb::cast<std::int64_t>(copy[2]),
                 size = static_cast<std::int64_t>(message.size());
      fits = fits && to >= 0 && from >= 0 && count >= 0 && to <= size && count <= size - to;
      const Copy kept{kHead + static_cast<std::size_t>(to), static_cast<std::size_t>(from),
          static_cast<std::size_t>(count)};
      made.copies.push_back(kept);
      made.needs = std::max(made.needs, kept.from + (topic.is_pose ? kMatrix : kept.count));
    }
    if (!fits || (topic.is_pose && (made.copies.size() != 1 || made.copies[0].count != kPose)))
      raise_shape_error(
          "Expected copies inside the message, one of 7 numbers for a pose, got other copies.");
    return made;
  }

  void write_all(const std::vector<std::string_view> &rows, std::optional<std::int64_t> first,
      std::uint64_t at, Made &made) const {
    for (std::size_t number = 0; number < rows.size() && !made.needs; ++number) {
      const std::string_view row = rows[number];
      if (row.size() < kShortest) {
        made.needs = kShortest, made.got = row.size();
        return;
      }
      const auto stamp = get<std::int64_t>(row.data());
      made.earliest = number ? std::min(made.earliest, stamp) : stamp;
      made.latest = number ? std::max(made.latest, stamp) : stamp;
      const auto sequence =
          first ? static_cast<std::uint32_t>(*first + static_cast<std::int64_t>(number))
                : get<std::uint32_t>(row.data() + 8);
      for (std::size_t k = 0; k < topics_.size() && !made.needs; ++k)
        write(k, row, stamp, sequence, at, made);
    }
  }

  void write(std::size_t k, std::string_view row, std::int64_t stamp, std::uint32_t sequence,
      std::uint64_t at, Made &made) const {
    const Topic &topic = topics_[k];
    bool is_there = topic.always;
    std::size_t set = 0, bit = 1;
    for (const Column &column : topic.columns) {
      const bool here = column.is_in(row);
      is_there = is_there || here;
      if (!column.optional) continue;
      if (here) set += bit;
      bit <<= 1;
    }
    if (!is_there) return;
    const Variant &variant = topic.variants[set];
    if (row.size() < variant.needs) {
      made.needs = variant.needs, made.got = row.size();
      return;
    }
    char entry[16];
    put(entry, stamp);
    put<std::uint64_t>(entry + 8, at + made.data.size());
    made.entries[k].append(entry, sizeof entry);
    const std::size_t start = made.data.size();
    made.data += variant.record;
    char *record = &made.data[start];
    put(record + kSequence, sequence);
    put(record + kLogTime, stamp);
    put(record + kPublishTime, stamp);
    std::int64_t seconds = stamp / kSecond, rest = stamp % kSecond;
    if (rest < 0) rest += kSecond, --seconds;
    put(record + kStamp, static_cast<std::int32_t>(seconds));
    put(record + kStamp + 4, static_cast<std::uint32_t>(rest));
    for (const Copy &copy : variant.copies) {
      if (topic.is_pose) write_pose(row.data() + copy.from, record + copy.to);
      else std::memcpy(record + copy.to, row.data() + copy.from, copy.count);
    }
  }

  std::vector<Topic> topics_;
};

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_row_encoder(nb::module_ &m) {
  nb::class_<RowEncoder>(m, "RowEncoder", "See _native.pyi.")
      .def(nb::init<nb::sequence>(), arg("topics"))
      .def("encode", &RowEncoder::encode, arg("rows"), arg("first").none() = nb::none(),
          arg("at") = 0);
}
