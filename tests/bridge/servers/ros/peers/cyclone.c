// A node in C with Cyclone DDS: DOMAIN COUNT FROM TO. Prints what it reads, a line each, until COUNT joint states came
// or a minute is over; says "reading" on standard error at the first. With each joint state from FROM to TO it
// commands a velocity.
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include "dds/dds.h"
#include "ros2.h"

#define AT_ONCE 64

static int64_t now_ns(void) {
  struct timespec t;
  clock_gettime(CLOCK_REALTIME, &t);
  return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static void head(char kind, const std_msgs_msg_dds__Header_ *header) {
  int64_t stamp = (int64_t)header->stamp.sec * 1000000000 + header->stamp.nanosec;
  printf("%c %" PRId64 " %" PRId64 " %s", kind, stamp, now_ns(), header->frame_id[0] ? header->frame_id : "-");
}

static dds_entity_t reader(dds_entity_t node, const dds_topic_descriptor_t *type, const char *name, int reliable) {
  dds_qos_t *qos = dds_create_qos();
  dds_qset_reliability(qos, reliable ? DDS_RELIABILITY_RELIABLE : DDS_RELIABILITY_BEST_EFFORT, 0);
  dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, 100);
  dds_entity_t made = dds_create_reader(node, dds_create_topic(node, type, name, NULL, NULL), qos, NULL);
  dds_delete_qos(qos);
  return made;
}

int main(int argc, char **argv) {
  if (argc != 5) return 2;
  long count = atol(argv[2]), from = atol(argv[3]), to = atol(argv[4]), joints = 0;
  dds_entity_t node = dds_create_participant((dds_domainid_t)atol(argv[1]), NULL, NULL);
  if (node < 0) return 3;
  dds_entity_t states = reader(node, &sensor_msgs_msg_dds__JointState__desc, "rt/yumi_left/joint_states", 1);
  dds_entity_t wrenches = reader(node, &geometry_msgs_msg_dds__WrenchStamped__desc, "rt/yumi_left/wrench", 0);
  dds_entity_t commands = dds_create_writer(node, dds_create_topic(node, &std_msgs_msg_dds__Float64MultiArray__desc,
      "rt/yumi_left/joint_group_velocity_controller/commands", NULL, NULL), NULL, NULL);
  dds_entity_t waiting = dds_create_waitset(node);
  for (int k = 0; k < 2; k++) {
    dds_entity_t one = k ? wrenches : states;
    dds_waitset_attach(waiting, dds_create_readcondition(one, DDS_ANY_STATE), one);
  }
  double velocities[7] = {0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05};
  std_msgs_msg_dds__Float64MultiArray_ command = {0};
  command.data._buffer = velocities;
  command.data._length = command.data._maximum = 7;
  for (int64_t end = now_ns() + 60000000000; joints < count && now_ns() < end;) {
    dds_attach_t which[2];
    dds_waitset_wait(waiting, which, 2, DDS_MSECS(100));
    void *samples[AT_ONCE] = {NULL};
    dds_sample_info_t infos[AT_ONCE];
    int n = dds_take(states, samples, infos, AT_ONCE, AT_ONCE);
    for (int k = 0; k < n; k++) {
      if (!infos[k].valid_data) continue;
      sensor_msgs_msg_dds__JointState_ *state = samples[k];
      head('J', &state->header);
      for (uint32_t i = 0; i < state->position._length; i++) printf(" %.17g", state->position._buffer[i]);
      printf(" %s %u\n", state->name._buffer[2], state->effort._length);
      if (joints++ == 0) fprintf(stderr, "reading\n");
      if (joints > from && joints <= to) dds_write(commands, &command);
    }
    if (n > 0) dds_return_loan(states, samples, n);
    samples[0] = NULL;
    n = dds_take(wrenches, samples, infos, AT_ONCE, AT_ONCE);
    for (int k = 0; k < n; k++) {
      if (!infos[k].valid_data) continue;
      geometry_msgs_msg_dds__WrenchStamped_ *one = samples[k];
      head('W', &one->header);
      geometry_msgs_msg_dds__Vector3_ f = one->wrench.force, m = one->wrench.torque;
      printf(" %.17g %.17g %.17g %.17g %.17g %.17g\n", f.x, f.y, f.z, m.x, m.y, m.z);
    }
    if (n > 0) dds_return_loan(wrenches, samples, n);
  }
  dds_delete(node);
  return 0;
}
