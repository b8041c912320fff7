// A node in C++ with Fast DDS: DOMAIN COUNT FROM TO [default]; see cyclone.c. It uses only 127.0.0.1; with "default",
// it has the settings of a program without a profile, like rmw_fastrtps_cpp.
#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <mutex>
#include <string>
#include <thread>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/DataReaderListener.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/transport/UDPv4TransportDescriptor.h>
#include <fastrtps/utils/IPLocator.h>

#include "ros2PubSubTypes.h"

using namespace eprosima::fastdds::dds;
using eprosima::fastdds::rtps::UDPv4TransportDescriptor;
using eprosima::fastrtps::rtps::IPLocator;
using JointState = sensor_msgs::msg::dds_::JointState_;
using WrenchStamped = geometry_msgs::msg::dds_::WrenchStamped_;
using Array = std_msgs::msg::dds_::Float64MultiArray_;

static std::mutex printing;

static int64_t now_ns() {
  using namespace std::chrono;
  return duration_cast<nanoseconds>(system_clock::now().time_since_epoch()).count();
}

static void head(char kind, const std_msgs::msg::dds_::Header_& header) {
  long long stamp = 1000000000LL * header.stamp().sec() + header.stamp().nanosec();
  const char* frame = header.frame_id().empty() ? "-" : header.frame_id().c_str();
  std::printf("%c %lld %lld %s", kind, stamp, (long long)now_ns(), frame);
}

template <typename Message, typename Use> struct Each : DataReaderListener {
  explicit Each(Use use) : use(use) {}
  void on_data_available(DataReader* reader) override {
    Message message;
    SampleInfo info;
    while (reader->take_next_sample(&message, &info) == ReturnCode_t::RETCODE_OK) {
      if (!info.valid_data) continue;
      std::lock_guard<std::mutex> one(printing);
      use(message);
    }
  }
  Use use;
};

static DomainParticipantQos on_this_computer(int domain) {
  DomainParticipantQos qos = PARTICIPANT_QOS_DEFAULT;
  auto transport = std::make_shared<UDPv4TransportDescriptor>();
  transport->interfaceWhiteList.push_back("127.0.0.1");
  qos.transport().use_builtin_transports = false;
  qos.transport().user_transports.push_back(transport);
  for (int k = 0; k < 10; k++) {
    eprosima::fastrtps::rtps::Locator_t peer;
    IPLocator::setIPv4(peer, 127, 0, 0, 1);
    peer.port = 7410 + 250 * domain + 2 * k;
    qos.wire_protocol().builtin.initialPeersList.push_back(peer);
  }
  return qos;
}

int main(int argc, char** argv) {
  const bool is_default = argc == 6 && std::string(argv[5]) == "default";
  if (argc != 5 && !is_default) return 2;
  const int domain = std::atoi(argv[1]);
  const long count = std::atol(argv[2]), from = std::atol(argv[3]), to = std::atol(argv[4]);
  DomainParticipant* node = DomainParticipantFactory::get_instance()->create_participant(
      domain, is_default ? PARTICIPANT_QOS_DEFAULT : on_this_computer(domain));
  if (node == nullptr) return 3;
  TypeSupport states(new sensor_msgs::msg::dds_::JointState_PubSubType());
  TypeSupport wrenches(new geometry_msgs::msg::dds_::WrenchStamped_PubSubType());
  TypeSupport arrays(new std_msgs::msg::dds_::Float64MultiArray_PubSubType());
  for (TypeSupport& type : {std::ref(states), std::ref(wrenches), std::ref(arrays)}) type.register_type(node);
  auto topic = [&](const char* name, TypeSupport& type) {
    return node->create_topic(std::string("rt/yumi_left/") + name, type.get_type_name(), TOPIC_QOS_DEFAULT);
  };
  Publisher* publisher = node->create_publisher(PUBLISHER_QOS_DEFAULT);
  DataWriter* commands = publisher->create_datawriter(
      topic("joint_group_velocity_controller/commands", arrays), DATAWRITER_QOS_DEFAULT);
  Array command;
  command.data().assign(7, 0.05);
  std::atomic<long> joints{0};
  auto state = [&](const JointState& one) {
    head('J', one.header());
    for (double q : one.position()) std::printf(" %.17g", q);
    std::printf(" %s %zu\n", one.name()[2].c_str(), one.effort().size());
    long k = ++joints;
    if (k == 1) std::fprintf(stderr, "reading\n");
    if (k > from && k <= to) commands->write(&command);
  };
  auto wrench = [&](const WrenchStamped& one) {
    head('W', one.header());
    const auto &f = one.wrench().force(), &m = one.wrench().torque();
    std::printf(" %.17g %.17g %.17g %.17g %.17g %.17g\n", f.x(), f.y(), f.z(), m.x(), m.y(), m.z());
  };
  Each<JointState, decltype(state)> each_state(state);
  Each<WrenchStamped, decltype(wrench)> each_wrench(wrench);
  Subscriber* subscriber = node->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
  DataReaderQos qos = DATAREADER_QOS_DEFAULT;
  qos.history().depth = 100;
  qos.reliability().kind = RELIABLE_RELIABILITY_QOS;
  subscriber->create_datareader(topic("joint_states", states), qos, &each_state);
  qos.reliability().kind = BEST_EFFORT_RELIABILITY_QOS;
  subscriber->create_datareader(topic("wrench", wrenches), qos, &each_wrench);
  for (int k = 0; k < 6000 && joints < count; k++) std::this_thread::sleep_for(std::chrono::milliseconds(10));
  node->delete_contained_entities();
  DomainParticipantFactory::get_instance()->delete_participant(node);
  std::fflush(stdout);
  return 0;
}
