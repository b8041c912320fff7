// An action client in C with Cyclone DDS, as rmw_cyclonedds is one: DOMAIN HOME..., the 7 joint positions at the start.
// Prints a line for each goal: its number, status, error code, feedback messages, and the text of the result. With
// another word at the end, it starts a long motion and waits to be killed.
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "dds/dds.h"
#include "actions.h"

#define PLACE "/yumi_left/joint_trajectory_controller/follow_joint_trajectory/_action/"
#define LONGEST DDS_SECS(30)
#define JOINTS 7
#define MANY 2000

typedef struct { uint64_t client; int64_t number; } Head;
typedef struct { dds_entity_t writer, reader; size_t size; } Service;
typedef control_msgs_action_dds__FollowJointTrajectory_SendGoal_Request_ SendGoal;
typedef control_msgs_action_dds__FollowJointTrajectory_SendGoal_Response_ Accepted;
typedef control_msgs_action_dds__FollowJointTrajectory_GetResult_Request_ GetResult;
typedef control_msgs_action_dds__FollowJointTrajectory_GetResult_Response_ Result;
typedef control_msgs_action_dds__FollowJointTrajectory_FeedbackMessage_ Feedback;
typedef action_msgs_srv_dds__CancelGoal_Request_ Cancel;
typedef action_msgs_srv_dds__CancelGoal_Response_ Canceling;

static dds_entity_t node, feedback;
static int64_t numbers;
static double home[JOINTS];
static int fed[256];

static dds_entity_t reader(const dds_topic_descriptor_t *type, const char *name, dds_qos_t *qos) {
  return dds_create_reader(node, dds_create_topic(node, type, name, NULL, NULL), qos, NULL);
}

static Service service(const char *name, const dds_topic_descriptor_t *request, const dds_topic_descriptor_t *response,
                       size_t size, dds_qos_t *qos) {
  char topic[200];
  snprintf(topic, sizeof topic, "rr" PLACE "%sReply", name);
  Service made = {0, reader(response, topic, qos), size};
  snprintf(topic, sizeof topic, "rq" PLACE "%sRequest", name);
  made.writer = dds_create_writer(node, dds_create_topic(node, request, topic, NULL, NULL), qos, NULL);
  for (dds_time_t end = dds_time() + LONGEST; dds_time() < end; dds_sleepfor(DDS_MSECS(20))) {
    dds_instance_handle_t one;
    if (dds_get_matched_subscriptions(made.writer, &one, 1) > 0 && dds_get_matched_publications(made.reader, &one, 1) > 0)
      return made;
  }
  fprintf(stderr, "no server of %s\n", name);
  exit(3);
}

static void read_feedback(void) {
  void *samples[16] = {NULL};
  dds_sample_info_t infos[16];
  int n = dds_take(feedback, samples, infos, 16, 16);
  for (int k = 0; k < n; k++) {
    Feedback *one = samples[k];
    if (infos[k].valid_data && one->feedback.desired.positions._length == JOINTS) fed[one->goal_id.uuid[0]]++;
  }
  if (n > 0) dds_return_loan(feedback, samples, n);
}

static int64_t ask(Service *service, void *request) {
  *(Head *)request = (Head){42, ++numbers};
  dds_write(service->writer, request);
  return numbers;
}

// Wait for the response to a request; it is never freed.
static void *answer(Service *service, int64_t number, dds_duration_t longest) {
  for (dds_time_t end = dds_time() + longest; dds_time() < end; dds_sleepfor(DDS_MSECS(2))) {
    void *one = calloc(1, service->size);
    dds_sample_info_t info;
    read_feedback();
    if (dds_take(service->reader, &one, &info, 1, 1) == 1 && info.valid_data) {
      Head *head = one;
      if (head->client == 42 && head->number == number) return one;
    }
  }
  return NULL;
}

static Service send_goal, get_result, cancel_goal;

// Send a goal: all joints by an offset from home in a time, in some points, which makes a large message; ask for its
// result, and return the number of the request.
static int64_t start(uint8_t id, double offset, int seconds, int count, const char *last) {
  static char names[JOINTS][32];
  static char *order[JOINTS];
  double (*positions)[JOINTS] = calloc(count, sizeof *positions), velocities[JOINTS] = {0};
  for (int i = 0; i < JOINTS; i++) {
    snprintf(names[i], sizeof names[i], "yumi_robl_joint_%d", JOINTS - i);
    order[i] = names[i];
    for (int k = 0; k < count; k++) positions[k][i] = home[JOINTS - 1 - i] + offset * (k + 1) / count;
  }
  if (last) order[JOINTS - 1] = (char *)last;
  trajectory_msgs_msg_dds__JointTrajectoryPoint_ *points = calloc(count, sizeof *points);
  for (int k = 0; k < count; k++) {
    int64_t ns = (k + 1) * 1000000000LL * seconds / count;
    points[k].positions._buffer = positions[k];
    points[k].positions._length = JOINTS;
    points[k].velocities._buffer = velocities;
    points[k].velocities._length = count == 1 ? JOINTS : 0;
    points[k].time_from_start.sec = ns / 1000000000;
    points[k].time_from_start.nanosec = ns % 1000000000;
  }
  SendGoal goal;
  memset(&goal, 0, sizeof goal);
  memset(goal.goal_id.uuid, id, 16);
  goal.goal.trajectory.header.frame_id = goal.goal.multi_dof_trajectory.header.frame_id = (char *)"";
  goal.goal.trajectory.joint_names._buffer = order;
  goal.goal.trajectory.joint_names._length = JOINTS;
  goal.goal.trajectory.points._buffer = points;
  goal.goal.trajectory.points._length = count;
  Accepted *accepted = answer(&send_goal, ask(&send_goal, &goal), LONGEST);
  if (accepted == NULL || !accepted->accepted) {
    fprintf(stderr, "goal %d was not accepted\n", id);
    exit(4);
  }
  GetResult request = {0};
  memset(request.goal_id.uuid, id, 16);
  return ask(&get_result, &request);
}

static Result *finish(uint8_t id, int64_t number) {
  Result *one = answer(&get_result, number, LONGEST);
  if (one == NULL) {
    fprintf(stderr, "no result of goal %d\n", id);
    exit(5);
  }
  return one;
}

static void tell(uint8_t id, int64_t number) {
  Result *one = finish(id, number);
  printf("%d %d %d %d %s\n", id, one->status, one->result.error_code, fed[id], one->result.error_string);
  fflush(stdout);
}

int main(int argc, char **argv) {
  if (argc != 2 + JOINTS && argc != 3 + JOINTS) return 2;
  for (int i = 0; i < JOINTS; i++) home[i] = atof(argv[2 + i]);
  node = dds_create_participant((dds_domainid_t)atol(argv[1]), NULL, NULL);
  dds_qos_t *qos = dds_create_qos();
  dds_qset_reliability(qos, DDS_RELIABILITY_RELIABLE, DDS_SECS(1));
  dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, 10);
  feedback = reader(&control_msgs_action_dds__FollowJointTrajectory_FeedbackMessage__desc, "rt" PLACE "feedback", qos);
#define SERVICE(name, type, out) service(name, &type##_Request__desc, &type##_Response__desc, sizeof(out), qos)
  send_goal = SERVICE("send_goal", control_msgs_action_dds__FollowJointTrajectory_SendGoal, Accepted);
  get_result = SERVICE("get_result", control_msgs_action_dds__FollowJointTrajectory_GetResult, Result);
  cancel_goal = SERVICE("cancel_goal", action_msgs_srv_dds__CancelGoal, Canceling);
  dds_instance_handle_t one;
  while (dds_get_matched_publications(feedback, &one, 1) < 1) dds_sleepfor(DDS_MSECS(20));
  uint8_t id = 10;
  for (int64_t number = start(id, 0.1, 1, MANY, NULL);; number = start(++id, 0.1, 1, MANY, NULL)) {  // until the arm is ready
    Result *one = finish(id, number);
    if (strstr(one->result.error_string, "not ready")) continue;
    printf("1 %d %d %d %s\n", one->status, one->result.error_code, fed[id], one->result.error_string);
    break;
  }
  if (argc == 3 + JOINTS) {
    start(2, 0.0, 60, 1, NULL);
    answer(&send_goal, -1, DDS_SECS(1));
    puts("moving");
    fflush(stdout);
    answer(&send_goal, -1, DDS_SECS(60));
    return 0;
  }
  int64_t slow = start(2, 0.0, 20, 1, NULL);
  answer(&send_goal, -1, DDS_MSECS(500));
  Cancel cancel = {0};
  memset(cancel.goal_info.goal_id.uuid, 2, 16);
  Canceling *canceling = answer(&cancel_goal, ask(&cancel_goal, &cancel), LONGEST);
  printf("C %d %u\n", canceling ? canceling->return_code : -1, canceling ? canceling->goals_canceling._length : 0);
  tell(2, slow);
  tell(3, start(3, 0.0, 1, 1, "elbow"));
  slow = start(4, 0.0, 20, 1, NULL);
  answer(&send_goal, -1, DDS_MSECS(500));
  int64_t newer = start(5, 0.05, 1, 1, NULL);
  tell(4, slow);
  tell(5, newer);
  dds_delete(node);
  return 0;
}
