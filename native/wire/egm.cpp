// Conversion of EGM datagrams to packets, and of references to datagrams. Documented in
// armlab/kernels/_native.pyi.
//
// Field numbers are those of armlab_egm.proto. A datagram is accepted if and only if protobuf
// accepts it, with one exception: protobuf counts messages towards its limit of 100 nested groups,
// but this reader counts only the groups within each message.
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "wire/protobuf.h"

namespace armlab::python {
namespace {

using namespace protobuf;

// clang-format off: table
namespace EgmHeader { enum { seqno = 1, tm = 2, mtype = 3 }; }
namespace EgmCartesian { enum { x = 1, y = 2, z = 3 }; }
namespace EgmQuaternion { enum { u0 = 1, u1 = 2, u2 = 3, u3 = 4 }; }
namespace EgmClock { enum { sec = 1, usec = 2 }; }
namespace EgmPose { enum { pos = 1, orient = 2, euler = 3 }; }
namespace EgmJoints { enum { joints = 1 }; }
namespace EgmMotion { enum { joints = 1, cartesian = 2, externalJoints = 3, time = 4, timeStamp = 5 }; }
namespace EgmSpeedRef { enum { joints = 1, cartesians = 2, externalJoints = 3 }; }
namespace EgmState { enum { state = 1 }; }
namespace EgmTestSignals { enum { signals = 1 }; }
namespace EgmForceRw6 { enum { force = 1 }; }
namespace EgmForceRw7 { enum { fcActive = 1, force = 2 }; }
namespace EgmCollisionInfo { enum { collsionTriggered = 1, collDetQuota = 2 }; }
namespace EgmRapidData { enum { digVal = 1, dnum = 2 }; }
namespace EgmRIState { enum {
  jointVel = 1, torqueMeas = 2, torqueRefTotal = 3, torqueGravity = 4, motorCurrent = 5, jointPosRef = 6,
  jointVelRef = 7, tNs = 8, overruns = 9, armId = 10, mode = 11, order = 12, usedSeqno = 13, queueDepth = 14
}; }
namespace EgmRIRef { enum {
  torqueFF = 1, velRef = 2, posRef = 3, posGainScale = 4, velGainScale = 5, echoTNs = 6, echoSeqno = 7,
  validMask = 8, order = 9
}; }
namespace EgmRobot { enum {
  header = 1, feedBack = 2, planned = 3, motorState = 4, mciState = 5, mciConvergenceMet = 6, testSignals = 7,
  rapidExecState = 8, measuredForce = 9, utilizationRate = 10, moveIndex = 11, collisionInfo = 12,
  rapidFromRobot = 13, torqueRef = 14, researchState = 101
}; }
namespace EgmSensor { enum { header = 1, planned = 2, speedRef = 3, rapidToRobot = 4, researchRef = 101 }; }
// clang-format on

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
// Degrees or mm: beyond the range of any arm. Differences of larger numbers could overflow.
constexpr double most = 1e9;
constexpr std::uint64_t max_seconds = 9'000'000'000, max_microseconds = 1'000'000'000;
constexpr int joints_at_most = 6, matrix_numbers = 16, kinematic = 1, data_type = 2,
              correction_type = 3;

struct Motion {
  Doubles joints, external;
  std::array<double, 7> pose;  // x, y, z [mm], u0 to u3
  bool has_position, has_orientation, has_time, has_stamp;
  std::uint64_t seconds, microseconds;

  void clear() {
    joints.clear(), external.clear(), pose.fill(0.0);
    has_position = has_orientation = has_time = has_stamp = false;
    seconds = microseconds = 0;
  }

  bool read(std::string_view data) {
    return walk(data, [this](const Field &field) {
      if (field.kind != message) return true;
      if (field.number == EgmMotion::joints)
        return read_doubles(field.bytes, EgmJoints::joints, joints);
      if (field.number == EgmMotion::externalJoints)
        return read_doubles(field.bytes, EgmJoints::joints, external);
      if (field.number == EgmMotion::cartesian) return read_pose(field.bytes);
      has_time = has_time || field.number == EgmMotion::time;
      has_stamp = has_stamp || field.number == EgmMotion::timeStamp;
      if (field.number == EgmMotion::time) return read_clock(field.bytes);
      return field.number != EgmMotion::timeStamp || is_well_formed(field.bytes);
    });
  }

 private:
  bool read_pose(std::string_view data) {
    return walk(data, [this](const Field &field) {
      if (field.kind != message) return true;
      has_position = has_position || field.number == EgmPose::pos;
      has_orientation = has_orientation || field.number == EgmPose::orient;
      if (field.number == EgmPose::pos)
        return read_numbers(field.bytes, pose.data(), EgmCartesian::z);
      if (field.number == EgmPose::orient)
        return read_numbers(field.bytes, pose.data() + 3, EgmQuaternion::u3);
      return field.number != EgmPose::euler || is_well_formed(field.bytes);
    });
  }

  bool read_clock(std::string_view data) {
    return walk(data, [this](const Field &field) {
      if (field.is_varint(EgmClock::sec)) seconds = field.integer;
      if (field.is_varint(EgmClock::usec)) microseconds = field.integer;
      return true;
    });
  }
};

// An EgmRobot in wire units.
struct Robot {
  std::uint32_t seqno, tm, order, queue_depth;
  std::int32_t mtype;
  std::array<std::int32_t, 3> states;  // motors, mci, rapid
  std::uint64_t mono;
  double utilization;
  bool has_seqno, has_tm, has_research, has_utilization, is_rw7, converged, digital;
  Motion feedback, planned;
  Doubles velocities, torques, torque_reference, data, force, unused;
  std::string_view force_bytes;

  bool read(std::string_view bytes) {
    seqno = tm = order = queue_depth = 0, mtype = 0, states.fill(0), mono = 0, utilization = nan;
    has_seqno = has_tm = has_research = has_utilization = is_rw7 = converged = digital = false;
    feedback.clear(), planned.clear(), force_bytes = {};
    for (Doubles *each : {&velocities, &torques, &torque_reference, &data, &force, &unused})
      each->clear();
    if (!walk(bytes, [this](const Field &field) { return take(field); })) return false;
    read_force();
    return true;
  }

  const char *flavour() const {
    if (is_rw7 || feedback.has_stamp) return "7";
    if (has_utilization) return "6.10";
    return feedback.has_time ? "6.07" : "6.06";
  }

 private:
  bool take(const Field &field) {
    if (field.kind == message) return take_message(field);
    if (field.number == EgmRobot::utilizationRate && field.kind == eight_bytes)
      utilization = get<double>(field.bytes.data()), has_utilization = true;
    if (field.is_varint(EgmRobot::mciConvergenceMet)) converged = field.integer != 0;
    if (field.is_varint(EgmRobot::moveIndex)) is_rw7 = true;
    return true;
  }

  bool take_message(const Field &field) {
    const std::uint32_t number = field.number;
    is_rw7 = is_rw7 || number == EgmRobot::collisionInfo || number == EgmRobot::rapidFromRobot ||
             number == EgmRobot::torqueRef;
    has_research = has_research || number == EgmRobot::researchState;
    if (number == EgmRobot::measuredForce) force_bytes = field.bytes;
    if (number == EgmRobot::header) return read_header(field.bytes);
    if (number == EgmRobot::feedBack) return feedback.read(field.bytes);
    if (number == EgmRobot::planned) return planned.read(field.bytes);
    if (number == EgmRobot::motorState) return read_state(field.bytes, states[0]);
    if (number == EgmRobot::mciState) return read_state(field.bytes, states[1]);
    if (number == EgmRobot::rapidExecState) return read_state(field.bytes, states[2]);
    if (number == EgmRobot::rapidFromRobot) return read_rapid(field.bytes);
    if (number == EgmRobot::researchState) return read_research(field.bytes);
    if (number == EgmRobot::testSignals)
      return read_doubles(field.bytes, EgmTestSignals::signals, unused);
    if (number == EgmRobot::collisionInfo)
      return read_doubles(field.bytes, EgmCollisionInfo::collDetQuota, unused);
    return number != EgmRobot::torqueRef ||
           read_doubles(field.bytes, EgmJoints::joints, torque_reference);
  }

  bool read_header(std::string_view bytes) {
    return walk(bytes, [this](const Field &field) {
      if (field.is_varint(EgmHeader::seqno))
        seqno = static_cast<std::uint32_t>(field.integer), has_seqno = true;
      if (field.is_varint(EgmHeader::tm))
        tm = static_cast<std::uint32_t>(field.integer), has_tm = true;
      if (field.is_varint(EgmHeader::mtype)) mtype = static_cast<std::int32_t>(field.integer);
      return true;
    });
  }

  static bool read_state(std::string_view bytes, std::int32_t &state) {
    return walk(bytes, [&state](const Field &field) {
      if (field.is_varint(EgmState::state)) state = static_cast<std::int32_t>(field.integer);
      return true;
    });
  }

  bool read_rapid(std::string_view bytes) {
    return walk(bytes, [this](const Field &field) {
      if (field.is_varint(EgmRapidData::digVal)) digital = field.integer != 0;
      return field.number != EgmRapidData::dnum || append(field, data);
    });
  }

  bool read_research(std::string_view bytes) {
    return walk(bytes, [this](const Field &field) {
      if (field.is_varint(EgmRIState::tNs)) mono = field.integer;
      if (field.is_varint(EgmRIState::order)) order = static_cast<std::uint32_t>(field.integer);
      if (field.is_varint(EgmRIState::queueDepth))
        queue_depth = static_cast<std::uint32_t>(field.integer);
      if (field.number == EgmRIState::jointVel) return append(field, velocities);
      if (field.number == EgmRIState::torqueMeas) return append(field, torques);
      return field.number > EgmRIState::jointVelRef || append(field, unused);
    });
  }

  // Reads either of two layouts, distinguished by the first tag. Malformed input counts as absent.
  void read_force() {
    const int tag = force_bytes.empty() ? 0 : force_bytes[0];
    const bool newer = tag == 0x08 || tag == 0x11 || tag == 0x12,
               older = tag == 0x09 || tag == 0x0a;
    if (!newer && !older) return;
    const std::uint32_t number = newer ? +EgmForceRw7::force : +EgmForceRw6::force;
    if (read_doubles(force_bytes, number, force)) is_rw7 = is_rw7 || newer;
    else force.clear();
  }
};

// Converts x, y, z [mm] and a quaternion to matrix rows [m]; NaN if the norm is unusable.
void matrix_of(const double *pose, double *out) {
  const double a = pose[3], b = pose[4], c = pose[5], d = pose[6];
  const double norm = a * a + b * b + c * c + d * d;
  if (!(1e-12 < norm && norm < 1e12)) {
    std::fill_n(out, matrix_numbers, nan);
    return;
  }
  const double s = 2.0 / norm;
  const double b2 = s * b * b, c2 = s * c * c, d2 = s * d * d, bc = s * b * c, bd = s * b * d,
               cd = s * c * d;
  const double ab = s * a * b, ac = s * a * c, ad = s * a * d;
  const double rows[matrix_numbers] = {1.0 - c2 - d2, bc - ad, bd + ac, 1e-3 * pose[0],  //
      bc + ad, 1.0 - b2 - d2, cd - ab, 1e-3 * pose[1],                                   //
      bd - ac, cd + ab, 1.0 - b2 - c2, 1e-3 * pose[2],                                   //
      0.0, 0.0, 0.0, 1.0};
  std::copy_n(rows, matrix_numbers, out);
}

Doubles doubles_of(nb::handle values, const char *name) {
  const Input given(values, name);
  return {given.data(), given.data() + given.size()};
}

std::uint64_t integer_of(nb::handle value) {
  const std::uint64_t found = PyLong_AsUnsignedLongLongMask(value.ptr());
  if (PyErr_Occurred()) throw nb::python_error();
  return found;
}

class EgmMessages {
 public:
  EgmMessages(nb::handle packet, nb::handle drop, std::vector<int> order, nb::handle scale,
      nb::handle external_scale, bool extension)
      : packet_(nb::borrow(packet)),
        drop_(nb::borrow(drop)),
        order_(std::move(order)),
        extension_(extension) {
    scale_ = doubles_of(scale, "scale"), beyond_ = doubles_of(external_scale, "external_scale");
    if (!PyType_Check(packet.ptr()) || !PyType_IsSubtype(type(), &PyTuple_Type) ||
        nb::len(nb::object(packet.attr("_fields"))) != fields)
      throw nb::type_error("Expected the named tuple of packets, with `fields` fields.");
    axes_.assign(order_.size(), -1);
    for (std::size_t k = 0; k < order_.size(); ++k)
      if (order_[k] >= 0 && order_[k] < n())
        axes_[static_cast<std::size_t>(order_[k])] = static_cast<int>(k);
    if (scale_.size() != order_.size() || std::find(axes_.begin(), axes_.end(), -1) != axes_.end())
      raise_shape_error("Expected each of " + std::to_string(n()) + " axes once, and its scale.");
    empty_ = fresh_array({0});
    PyArray_CLEARFLAGS(as_array(empty_), NPY_ARRAY_WRITEABLE);
    measured_ = nb::str("measured"), reference_ = nb::str("reference"), none_ = nb::str("none");
  }

  nb::object read(nb::handle data, nb::str robotware) {
    if (!PyBytes_Check(data.ptr())) throw nb::type_error("Expected the bytes of one datagram.");
    const std::string_view bytes = view(data);
    if (!robot_.read(bytes))
      return drop_("unparsable", std::to_string(bytes.size()) + " bytes are no protobuf message");
    if (!robot_.has_seqno)
      return drop_("no header", "a message without a header that has a sequence number");
    if (robot_.mtype != data_type)
      return drop_("wrong type",
          "expected message type 2 (data from the robot), got " + std::to_string(robot_.mtype));
    const Doubles &joints = robot_.feedback.joints, &external = robot_.feedback.external;
    if (joints.empty() && (head() || external.empty()))
      return drop_("no joints", "the array of joints is absent or empty");
    if (!are_joints(robot_.feedback))
      return drop_("joint count", "expected " + std::to_string(head()) + " joints and at least " +
                                      std::to_string(tail()) + " external, got " +
                                      std::to_string(joints.size()) + " and " +
                                      std::to_string(external.size()));
    for (const Doubles *values : {&robot_.velocities, &robot_.torques})
      if (!values->empty() && values->size() != order_.size())
        return drop_("joint count", "expected " + std::to_string(n()) +
                                        " values in each array of the extension, got " +
                                        std::to_string(values->size()));
    const auto is_sound = [](double value) { return std::abs(value) <= most; };
    for (const Doubles *values :
        {&joints, &external, static_cast<const Doubles *>(&robot_.velocities)})
      if (!std::all_of(values->begin(), values->end(), is_sound))
        return drop_(
            "not finite", "a joint, a velocity or an external axis is no number, or beyond 1e9");
    if (PyUnicode_GET_LENGTH(robotware.ptr()) == 0) robotware = nb::str(robot_.flavour());
    return packet(robotware);
  }

  nb::bytes write(nb::tuple ref) {
    if (ref.size() != 9) throw nb::type_error("Expected a reference.");
    out_.clear();
    FieldWriter out(out_);
    out.nested(EgmSensor::header, [&] {
      out.integer(EgmHeader::seqno, integer_of(ref[3]) & 0xffffffff);
      out.integer(EgmHeader::tm, integer_of(ref[4]) & 0xffffffff);
      out.integer(EgmHeader::mtype, correction_type);
    });
    const nb::object beside = ref[8];
    const auto extra = [&beside](std::size_t k) {
      return beside.is_none() ? nb::none() : nb::object(nb::borrow<nb::tuple>(beside)[k]);
    };
    if (!beside.is_none() && (!PyTuple_Check(beside.ptr()) || nb::len(beside) != 4))
      throw nb::type_error("Expected the part of a reference besides the joints.");
    motion(out, EgmSensor::planned, ref[0], extra(0));
    if (!ref[1].is_none()) motion(out, EgmSensor::speedRef, ref[1], extra(1));
    rapid(out, extra(2), extra(3));
    if (extension_) research(out, ref);
    return nb::bytes(out_.data(), out_.size());
  }

 private:
  static constexpr Py_ssize_t fields = 21;  // fields of `Packet`, set by packet() in order

  PyTypeObject *type() const { return reinterpret_cast<PyTypeObject *>(packet_.ptr()); }
  int n() const { return static_cast<int>(order_.size()); }
  std::size_t head() const { return std::min<std::size_t>(order_.size(), joints_at_most); }
  std::size_t tail() const { return order_.size() - head(); }
  double beyond(std::size_t k) const { return k < beyond_.size() ? beyond_[k] : M_PI / 180.0; }

  bool are_joints(const Motion &motion) const {
    return (!motion.joints.empty() || (!head() && !motion.external.empty())) &&
           motion.joints.size() == head() && motion.external.size() >= tail();
  }

  // Writes the joints of a motion in kinematic order, scaled.
  void joints_of(const Motion &motion, bool in_radians, double *to) const {
    for (std::size_t k = 0; k < order_.size(); ++k) {
      const auto axis = static_cast<std::size_t>(order_[k]);
      to[k] = (axis < head() ? motion.joints[axis] : motion.external[axis - head()]) *
              (in_radians ? 1.0 : scale_[k]);
    }
  }

  // Writes an array in kinematic order; NaN if absent.
  void array_of(const Doubles &values, bool is_kinematic, double *to) const {
    for (std::size_t k = 0; k < order_.size(); ++k) {
      const std::size_t from = is_kinematic ? k : static_cast<std::size_t>(order_[k]);
      to[k] = from < values.size() ? values[from] : nan;
    }
  }

  nb::object packet(const nb::str &robotware) {
    const bool in_radians = PyUnicode_CompareWithASCIIString(robotware.ptr(), "6.06") == 0;
    const Motion &feedback = robot_.feedback;
    const std::size_t joints = order_.size(), external = feedback.external.size() - tail(),
                      count = robot_.data.size();
    const auto length = static_cast<npy_intp>(4 * joints + 6 + external + count + matrix_numbers);
    const nb::object values = fresh_array(1, &length);
    double *q = numbers(values), *qd = q + joints, *planned = qd + joints, *tau = planned + joints;
    double *force = tau + joints, *beyond_q = force + 6, *data = beyond_q + external;
    double *pose = data + count;
    joints_of(feedback, in_radians, q);
    const bool is_kinematic = robot_.order == kinematic;
    array_of(robot_.velocities, is_kinematic, qd);
    for (std::size_t k = 0; k < joints; ++k) qd[k] *= scale_[k];
    if (are_joints(robot_.planned)) joints_of(robot_.planned, in_radians, planned);
    else std::fill_n(planned, joints, nan);
    const bool has_torque = !robot_.torques.empty();
    const bool has_reference = !has_torque && head() && robot_.torque_reference.size() == head();
    array_of(
        has_torque ? robot_.torques : robot_.torque_reference, has_torque && is_kinematic, tau);
    for (std::size_t k = 0; k < 6; ++k) force[k] = robot_.force.size() == 6 ? robot_.force[k] : nan;
    for (std::size_t k = 0; k < external; ++k)
      beyond_q[k] = feedback.external[tail() + k] * (in_radians ? 1.0 : beyond(k));
    std::copy_n(robot_.data.data(), count, data);
    if (feedback.has_position && feedback.has_orientation) matrix_of(feedback.pose.data(), pose);
    else std::fill_n(pose, matrix_numbers, nan);
    PyArray_CLEARFLAGS(as_array(values), NPY_ARRAY_WRITEABLE);

    const nb::object made = nb::steal(type()->tp_alloc(type(), fields));
    if (!made.is_valid()) throw nb::python_error();
    Py_ssize_t field = 0;
    const auto set = [&](nb::object value) {
      if (field == fields) raise_shape_error("Expected no more values than a packet has fields.");
      PyTuple_SET_ITEM(made.ptr(), field++, value.release().ptr());
    };
    const auto vector = [&](double *at, std::size_t size) {
      const auto shape = static_cast<npy_intp>(size);
      return part(values, at, 1, &shape);
    };
    const bool counts = feedback.seconds < max_seconds && feedback.microseconds < max_microseconds;
    const npy_intp square[2] = {4, 4};
    set(nb::int_(robot_.seqno));
    set(robot_.has_tm ? nb::object(nb::int_(robot_.tm)) : nb::none());
    set(nb::int_(counts ? feedback.seconds * 1'000'000'000 + feedback.microseconds * 1000 : 0));
    set(vector(q, joints));
    set(vector(planned, joints));
    set(external ? vector(beyond_q, external) : empty_);
    set(robot_.velocities.empty() ? nb::none() : vector(qd, joints));
    set(has_torque || has_reference ? vector(tau, joints) : nb::none());
    set(has_torque ? measured_ : has_reference ? reference_ : none_);
    set(part(values, pose, 2, square));
    set(vector(force, 6));
    for (const std::int32_t state : robot_.states) set(nb::int_(state));
    set(nb::bool_(robot_.converged));
    set(nb::float_(robot_.utilization));
    set(robotware);
    set(count ? vector(data, count) : empty_);
    set(nb::bool_(robot_.digital));
    set(nb::int_(robot_.mono));
    set(robot_.has_research ? nb::object(nb::int_(robot_.queue_depth)) : nb::object(nb::int_(-1)));
    return made;
  }

  // Returns a read-only view of some of the values.
  static nb::object part(const nb::object &values, double *data, int ndim, const npy_intp *shape) {
    const nb::object array = nb::steal(PyArray_New(&PyArray_Type, ndim, shape, NPY_DOUBLE, nullptr,
        data, 0, NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_ALIGNED, nullptr));
    if (!array.is_valid() ||
        PyArray_SetBaseObject(as_array(array), nb::object(values).release().ptr()) < 0)
      throw nb::python_error();
    return array;
  }

  // Writes the robot's axes, the seventh and later ones as external joints, then additional axes.
  void motion(FieldWriter &out, int number, nb::handle values, const nb::object &external) const {
    const Input given(values, "joints", {n()});
    const auto axis = [&](std::size_t k) {
      const auto joint = static_cast<std::size_t>(axes_[k]);
      out.real(EgmJoints::joints, given.data()[joint] / scale_[joint]);
    };
    const Doubles more = external.is_none() ? Doubles() : doubles_of(external, "external axes");
    out.nested(number, [&] {
      out.nested(EgmMotion::joints, [&] {
        for (std::size_t k = 0; k < head(); ++k) axis(k);
      });
      if (!tail() && more.empty()) return;
      out.nested(EgmMotion::externalJoints, [&] {
        for (std::size_t k = head(); k < order_.size(); ++k) axis(k);
        for (std::size_t k = 0; k < more.size(); ++k)
          out.real(EgmJoints::joints, more[k] / beyond(k));
      });
    });
  }

  static void rapid(FieldWriter &out, const nb::object &numbers, const nb::object &digital) {
    if (numbers.is_none() && digital.is_none()) return;
    out.nested(EgmSensor::rapidToRobot, [&] {
      if (!digital.is_none()) out.integer(EgmRapidData::digVal, nb::cast<bool>(nb::bool_(digital)));
      if (numbers.is_none()) return;
      for (const double value : doubles_of(numbers, "rapid_data"))
        out.real(EgmRapidData::dnum, value);
    });
  }

  void research(FieldWriter &out, const nb::tuple &ref) const {
    const bool has_torque = !ref[2].is_none(), free = nb::cast<bool>(nb::bool_(ref[7]));
    out.nested(EgmSensor::researchRef, [&] {
      if (has_torque) {
        const Input torque(ref[2], "torques", {n()});
        out.packed(EgmRIRef::torqueFF, torque.data(), order_.size());
      }
      const Doubles loosened(free ? order_.size() : 0, 0.0);
      out.packed(EgmRIRef::posGainScale, loosened.data(), loosened.size());
      out.packed(EgmRIRef::velGainScale, loosened.data(), loosened.size());
      out.integer(EgmRIRef::echoTNs, integer_of(ref[6]));
      out.integer(EgmRIRef::echoSeqno, integer_of(ref[5]) & 0xffffffff);
      const unsigned gains =
          1u << (EgmRIRef::posGainScale - 1) | 1u << (EgmRIRef::velGainScale - 1);
      out.integer(EgmRIRef::validMask, (has_torque ? 1u : 0u) | (free ? gains : 0u));
      out.integer(EgmRIRef::order, kinematic);
    });
  }

  nb::object packet_, drop_, empty_, measured_, reference_, none_;
  std::vector<int> order_, axes_;  // axis of each joint; joint of each axis
  Doubles scale_, beyond_;         // SI per wire unit
  bool extension_;
  Robot robot_;      // kept to reuse its memory
  std::string out_;  // kept to reuse its memory
};

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_egm(nb::module_ &m) {
  nb::class_<EgmMessages>(m, "EgmMessages", "See _native.pyi.")
      .def(nb::init<nb::handle, nb::handle, std::vector<int>, nb::handle, nb::handle, bool>(),
          arg("packet"), arg("drop"), arg("order"), array("scale"), array("external_scale"),
          arg("extension"))
      .def("read", &EgmMessages::read, arg("data"), arg("robotware"))
      .def("write", &EgmMessages::write, arg("ref"));
}
