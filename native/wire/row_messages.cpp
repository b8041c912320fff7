// Messages of one row for other programs. Documented in armlab/kernels/_native.pyi.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "array/arrays.h"
#include "wire/bytes.h"
#include "math/arm/kinematics.h"
#include "math/lie/lie.h"

namespace armlab {
namespace {

constexpr std::int64_t second = 1'000'000'000;
constexpr std::size_t pose_numbers = 7;
enum class Kind { copied, turned, pose };

template <class T>
void put(char *to, T value) {
  std::memcpy(to, &value, sizeof value);
}

struct Column {
  std::size_t at, count;

  bool is_in(const char *row) const {
    for (std::size_t k = 0; k < count; ++k)
      if (std::isnan(get<double>(row + at + 8 * k))) return false;
    return true;
  }
};

struct Copy {
  std::size_t to, at, count;
};

struct Variant {
  bool exists = false;
  std::string message;
  std::size_t stamp = 0;
  std::vector<Copy> copies;
};

struct Topic {
  std::size_t fresh, joints;
  std::vector<Column> columns;
  std::vector<Variant> variants;
  Kind kind;
  nb::object chain_object;  // keeps the chain alive
  const Chain *chain;
};

class RowMessages {
 public:
  RowMessages(nb::bytes head, std::size_t size, std::size_t clock, nb::sequence topics)
      : head_(view(head)), size_(size), clock_(clock) {
    inside(clock, 8, size);
    for (nb::handle each : topics) topics_.push_back(topic(nb::cast<nb::tuple>(each)));
  }

  nb::list of_row(nb::bytes row_, nb::sequence wanted) const {
    const std::string_view row = view(row_);
    if (row.size() != size_ || row.substr(0, head_.size()) != head_)
      raise_shape_error("Expected a row of " + std::to_string(size_) + " bytes of this schema, got " +
                        std::to_string(row.size()) + " bytes.");
    nb::list messages;
    const Chain *known = nullptr;
    std::size_t known_joints = 0;
    Pose<double> tool;
    for (nb::handle each : wanted) {
      const auto number = nb::cast<std::int64_t>(each);
      if (number < 0 || number >= static_cast<std::int64_t>(topics_.size()))
        raise_shape_error("Expected numbers of " + std::to_string(topics_.size()) + " topics, got " +
                          std::to_string(number) + ".");
      const Topic &topic = topics_[static_cast<std::size_t>(number)];
      const Variant *variant = variant_of(topic, row.data());
      if (!variant) {
        messages.append(nb::none());
        continue;
      }
      if (topic.chain && (topic.chain != known || topic.joints != known_joints)) {
        double q[max_joints];
        std::memcpy(q, row.data() + topic.joints, static_cast<std::size_t>(topic.chain->n) * sizeof *q);
        tool = walk(*topic.chain, q, [](int, const Vec3<double> &, const Vec3<double> &) {});
        known = topic.chain, known_joints = topic.joints;
      }
      messages.append(message(topic.kind, *variant, row.data(), tool));
    }
    return messages;
  }

 private:
  void inside(std::size_t at, std::size_t count, std::size_t size) const {
    if (count > size || at > size - count)
      raise_shape_error("Expected topics whose places are inside of rows and messages, got others.");
  }

  void require(bool holds) const {
    if (!holds) inside(1, 1, 0);
  }

  Topic topic(const nb::tuple &given) const {
    const auto kind = nb::cast<int>(given[3]);
    require(kind >= 0 && kind <= 2);
    Topic made{place(given[0]), 0, {}, {}, static_cast<Kind>(kind), {}, nullptr};
    inside(made.fresh, 8, size_);
    for (nb::handle column : given[1]) {
      made.columns.push_back({place(column[0]), place(column[1])});
      inside(made.columns.back().at, 8 * made.columns.back().count, size_);
    }
    if (made.kind != Kind::copied) {
      made.chain_object = nb::borrow(given[4]);
      made.chain = &nb::cast<const Chain &>(made.chain_object);
      made.joints = place(given[5]);
      inside(made.joints, 8 * static_cast<std::size_t>(made.chain->n), size_);
    }
    for (nb::handle variant : given[2]) made.variants.push_back(variant_from(variant, made.kind));
    require(made.columns.size() < 16 && made.variants.size() == std::size_t{1} << made.columns.size());
    return made;
  }

  Variant variant_from(nb::handle given, Kind kind) const {
    Variant made;
    if (given.is_none()) return made;
    made.exists = true;
    made.message = view(given[0]);
    made.stamp = place(given[1]);
    inside(made.stamp, 8, made.message.size());
    for (nb::handle copy : given[2]) {
      const Copy one{place(copy[0]), place(copy[1]), place(copy[2])};
      inside(one.to, 8 * one.count, made.message.size());
      if (kind == Kind::pose)
        require(one.count == pose_numbers);
      else
        inside(one.at, 8 * one.count, size_);
      require(kind != Kind::turned || one.count % 3 == 0);
      made.copies.push_back(one);
    }
    return made;
  }

  std::size_t place(nb::handle number) const {
    const auto value = nb::cast<std::int64_t>(number);
    require(value >= 0 && value < (std::int64_t{1} << 32));
    return static_cast<std::size_t>(value);
  }

  const Variant *variant_of(const Topic &topic, const char *row) const {
    if (!get<std::int64_t>(row + topic.fresh)) return nullptr;
    std::size_t set = 0;
    for (std::size_t k = 0; k < topic.columns.size(); ++k)
      if (topic.columns[k].is_in(row)) set |= std::size_t{1} << k;
    return topic.variants[set].exists ? &topic.variants[set] : nullptr;
  }

  nb::object message(Kind kind, const Variant &variant, const char *row, const Pose<double> &tool) const {
    PyObject *fresh = PyBytes_FromStringAndSize(variant.message.data(), static_cast<Py_ssize_t>(variant.message.size()));
    if (!fresh) throw nb::python_error();
    char *to = PyBytes_AS_STRING(fresh);
    const auto stamp = get<std::int64_t>(row + clock_);
    std::int64_t seconds = stamp / second, rest = stamp % second;
    if (rest < 0) rest += second, --seconds;
    put(to + variant.stamp, static_cast<std::uint32_t>(seconds));
    put(to + variant.stamp + 4, static_cast<std::uint32_t>(rest));
    for (const Copy &copy : variant.copies) {
      if (kind == Kind::copied)
        std::memcpy(to + copy.to, row + copy.at, 8 * copy.count);
      else if (kind == Kind::turned)
        turn(tool, copy, row, to);
      else
        write_pose(tool, to + copy.to);
    }
    return nb::steal(fresh);
  }

  static void turn(const Pose<double> &tool, const Copy &copy, const char *row, char *to) {
    for (std::size_t k = 0; k < 8 * copy.count; k += 24) {
      const char *at = row + copy.at + k;
      const Vec3<double> turned = tool.turn_back({get<double>(at), get<double>(at + 8), get<double>(at + 16)});
      put(to + copy.to + k, turned.x);
      put(to + copy.to + k + 8, turned.y);
      put(to + copy.to + k + 16, turned.z);
    }
  }

  static void write_pose(const Pose<double> &tool, char *to) {
    const Quaternion<double> q = quaternion_from(Rotation<double>{tool.x, tool.y, tool.z});
    const double numbers[pose_numbers] = {tool.p.x, tool.p.y, tool.p.z, q.v.x, q.v.y, q.v.z, q.w};
    std::memcpy(to, numbers, sizeof numbers);
  }

  std::string head_;
  std::size_t size_, clock_;
  std::vector<Topic> topics_;
};

}  // namespace
}  // namespace armlab

void bind_row_messages(nb::module_ &m) {
  using armlab::RowMessages;
  nb::class_<RowMessages>(m, "RowMessages", "See _native.pyi.")
      .def(nb::init<nb::bytes, std::size_t, std::size_t, nb::sequence>(), nb::arg("head"), nb::arg("size"),
           nb::arg("clock"), nb::arg("topics"))
      .def("of_row", &RowMessages::of_row, nb::arg("row"), nb::arg("wanted"));
}
