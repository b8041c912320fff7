// Action client in C++ with Fast DDS and default settings, like rmw_fastrtps; see actions.c.
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <string>
#include <thread>

#include <fastdds/dds/domain/DomainParticipant.hpp>
#include <fastdds/dds/domain/DomainParticipantFactory.hpp>
#include <fastdds/dds/publisher/DataWriter.hpp>
#include <fastdds/dds/publisher/Publisher.hpp>
#include <fastdds/dds/subscriber/DataReader.hpp>
#include <fastdds/dds/subscriber/SampleInfo.hpp>
#include <fastdds/dds/subscriber/Subscriber.hpp>
#include <fastdds/dds/topic/TypeSupport.hpp>
#include <fastdds/rtps/common/WriteParams.h>

#include "actionsPubSubTypes.h"

using namespace eprosima::fastdds::dds;
using eprosima::fastrtps::rtps::WriteParams;
namespace act = control_msgs::action::dds_;

static const std::string PLACE = "/yumi_left/joint_trajectory_controller/follow_joint_trajectory/_action/";
static const int JOINTS = 7, MANY = 2000;
static DomainParticipant* node;
static Publisher* publisher;
static Subscriber* subscriber;
static DataReader* feedback;
static std::map<int, int> fed;
static double home[JOINTS];

static Topic* topic(const std::string& name, TypeSupport type) {
  type.register_type(node);
  return node->create_topic(name, type.get_type_name(), TOPIC_QOS_DEFAULT);
}

static void read_feedback() {
  act::FollowJointTrajectory_FeedbackMessage_ one;
  SampleInfo info;
  while (feedback->take_next_sample(&one, &info) == ReturnCode_t::RETCODE_OK)
    if (info.valid_data && one.feedback().desired().positions().size() == JOINTS) fed[one.goal_id().uuid()[0]]++;
}

template <typename Request, typename RequestType, typename Response, typename ResponseType> struct Client {
  DataWriter* writer;
  DataReader* reader;

  explicit Client(const std::string& name) {
    DataReaderQos in = DATAREADER_QOS_DEFAULT;
    in.reliability().kind = RELIABLE_RELIABILITY_QOS;
    in.history().depth = 10;
    DataWriterQos out = DATAWRITER_QOS_DEFAULT;
    out.reliability().kind = RELIABLE_RELIABILITY_QOS;
    out.publish_mode().kind = ASYNCHRONOUS_PUBLISH_MODE;  // needed for messages above 64 kB
    reader = subscriber->create_datareader(topic("rr" + PLACE + name + "Reply", TypeSupport(new ResponseType())), in);
    writer = publisher->create_datawriter(topic("rq" + PLACE + name + "Request", TypeSupport(new RequestType())), out);
    for (int k = 0; k < 1500; k++, std::this_thread::sleep_for(std::chrono::milliseconds(20))) {
      PublicationMatchedStatus sent;
      SubscriptionMatchedStatus taken;
      writer->get_publication_matched_status(sent);
      reader->get_subscription_matched_status(taken);
      if (sent.current_count > 0 && taken.current_count > 0) return;
    }
    std::fprintf(stderr, "no server of %s\n", name.c_str());
    std::exit(3);
  }

  auto ask(Request request) {
    WriteParams params;
    params.related_sample_identity().writer_guid() = reader->guid();
    writer->write(&request, params);
    return params.sample_identity().sequence_number();
  }

  template <typename Number> Response answer(Number number, int ms = 30000) {
    for (int k = 0; k < ms / 2; k++, std::this_thread::sleep_for(std::chrono::milliseconds(2))) {
      Response response;
      SampleInfo info;
      read_feedback();
      if (reader->take_next_sample(&response, &info) != ReturnCode_t::RETCODE_OK || !info.valid_data) continue;
      const auto& related = info.related_sample_identity;
      const bool is_ours = related.writer_guid() == writer->guid() || related.writer_guid() == reader->guid();
      if (is_ours && related.sequence_number() == number) return response;
    }
    std::fprintf(stderr, "no response\n");
    std::exit(4);
  }
};

using SendGoal = Client<act::FollowJointTrajectory_SendGoal_Request_,
                        act::FollowJointTrajectory_SendGoal_Request_PubSubType,
                        act::FollowJointTrajectory_SendGoal_Response_,
                        act::FollowJointTrajectory_SendGoal_Response_PubSubType>;
using GetResult = Client<act::FollowJointTrajectory_GetResult_Request_,
                         act::FollowJointTrajectory_GetResult_Request_PubSubType,
                         act::FollowJointTrajectory_GetResult_Response_,
                         act::FollowJointTrajectory_GetResult_Response_PubSubType>;
using Cancel = Client<action_msgs::srv::dds_::CancelGoal_Request_, action_msgs::srv::dds_::CancelGoal_Request_PubSubType,
                      action_msgs::srv::dds_::CancelGoal_Response_,
                      action_msgs::srv::dds_::CancelGoal_Response_PubSubType>;

static void pause(int ms) {
  for (int k = 0; k < ms / 10; k++, std::this_thread::sleep_for(std::chrono::milliseconds(10))) read_feedback();
}

static std::array<uint8_t, 16> uuid(int id) {
  std::array<uint8_t, 16> made;
  made.fill(id);
  return made;
}

static auto start(SendGoal& goals, GetResult& results, int id, double offset, int seconds, int count,
                  const char* last = nullptr) {
  act::FollowJointTrajectory_SendGoal_Request_ request;
  request.goal_id().uuid(uuid(id));
  auto& trajectory = request.goal().trajectory();
  for (int i = JOINTS; i > 0; i--) trajectory.joint_names().push_back("yumi_robl_joint_" + std::to_string(i));
  if (last) trajectory.joint_names().back() = last;
  for (int k = 1; k <= count; k++) {
    trajectory_msgs::msg::dds_::JointTrajectoryPoint_ point;
    for (int i = JOINTS; i > 0; i--) point.positions().push_back(home[i - 1] + offset * k / count);
    if (count == 1) point.velocities().assign(JOINTS, 0.0);
    const long long ns = k * 1000000000LL * seconds / count;
    point.time_from_start().sec(ns / 1000000000);
    point.time_from_start().nanosec(ns % 1000000000);
    trajectory.points().push_back(point);
  }
  if (!goals.answer(goals.ask(request)).accepted()) std::exit(5);
  act::FollowJointTrajectory_GetResult_Request_ asked;
  asked.goal_id().uuid(uuid(id));
  return results.ask(asked);
}

template <typename Number> static std::string tell(GetResult& results, int id, Number number, int shown) {
  const auto one = results.answer(number);
  const std::string text = one.result().error_string();
  if (text.find("not ready") == std::string::npos)
    std::printf("%d %d %d %d %s\n", shown, one.status(), one.result().error_code(), fed[id], text.c_str());
  std::fflush(stdout);
  return text;
}

int main(int argc, char** argv) {
  if (argc != 2 + JOINTS) return 2;
  for (int i = 0; i < JOINTS; i++) home[i] = std::atof(argv[2 + i]);
  node = DomainParticipantFactory::get_instance()->create_participant(std::atoi(argv[1]), PARTICIPANT_QOS_DEFAULT);
  if (node == nullptr) return 3;
  publisher = node->create_publisher(PUBLISHER_QOS_DEFAULT);
  subscriber = node->create_subscriber(SUBSCRIBER_QOS_DEFAULT);
  feedback = subscriber->create_datareader(
      topic("rt" + PLACE + "feedback", TypeSupport(new act::FollowJointTrajectory_FeedbackMessage_PubSubType())),
      DATAREADER_QOS_DEFAULT);
  SendGoal goals("send_goal");
  GetResult results("get_result");
  Cancel cancel("cancel_goal");
  SubscriptionMatchedStatus matched;
  while (feedback->get_subscription_matched_status(matched), matched.current_count < 1) pause(20);
  int id = 10;
  while (tell(results, id, start(goals, results, id, 0.1, 1, MANY), 1).find("not ready") != std::string::npos) id++;
  auto slow = start(goals, results, 2, 0.0, 20, 1);
  pause(500);
  action_msgs::srv::dds_::CancelGoal_Request_ request;
  request.goal_info().goal_id().uuid(uuid(2));
  const auto canceling = cancel.answer(cancel.ask(request));
  std::printf("C %d %zu\n", canceling.return_code(), canceling.goals_canceling().size());
  tell(results, 2, slow, 2);
  tell(results, 3, start(goals, results, 3, 0.0, 1, 1, "elbow"), 3);
  slow = start(goals, results, 4, 0.0, 20, 1);
  pause(500);
  const auto newer = start(goals, results, 5, 0.05, 1, 1);
  tell(results, 4, slow, 4);
  tell(results, 5, newer, 5);
  node->delete_contained_entities();
  DomainParticipantFactory::get_instance()->delete_participant(node);
  return 0;
}
