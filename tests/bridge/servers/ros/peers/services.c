// A node in C with Cyclone DDS: DOMAIN. Lists the parameters of yumi_left, sets the gain to 0.75 and to 7.5, reads it,
// as rmw_cyclonedds does; prints a line for each. The responses to others, which come too, are passed over.
#include <stdio.h>
#include <stdlib.h>
#include <unistd.h>
#include "dds/dds.h"
#include "services.h"

static dds_entity_t node;
static const unsigned long long us = 0x1122334455667788ULL;
static long long number = 0;

typedef struct { dds_entity_t writer, reader; } Client;

static Client client(const char *name, const dds_topic_descriptor_t *request, const dds_topic_descriptor_t *response) {
  char topic[128];
  dds_qos_t *qos = dds_create_qos();
  dds_qset_reliability(qos, DDS_RELIABILITY_RELIABLE, DDS_SECS(1));
  dds_qset_history(qos, DDS_HISTORY_KEEP_LAST, 10);
  Client made;
  snprintf(topic, sizeof topic, "rq/yumi_left/%sRequest", name);
  made.writer = dds_create_writer(node, dds_create_topic(node, request, topic, NULL, NULL), qos, NULL);
  snprintf(topic, sizeof topic, "rr/yumi_left/%sReply", name);
  made.reader = dds_create_reader(node, dds_create_topic(node, response, topic, NULL, NULL), qos, NULL);
  dds_delete_qos(qos);
  for (int k = 0; k < 2000; k++) {
    dds_publication_matched_status_t out;
    dds_subscription_matched_status_t in;
    dds_get_publication_matched_status(made.writer, &out);
    dds_get_subscription_matched_status(made.reader, &in);
    if (out.current_count && in.current_count) return made;
    usleep(10000);
  }
  exit(4);
}

// The response to our newest request; all begin with the client and the number.
static void *response(Client one) {
  for (int k = 0; k < 2000; k++) {
    static void *sample[1];
    dds_sample_info_t info;
    sample[0] = NULL;
    if (dds_take(one.reader, sample, &info, 1, 1) > 0 && info.valid_data) {
      unsigned long long *head = sample[0];
      if (head[0] == us && (long long)head[1] == number) return sample[0];
    }
    usleep(5000);
  }
  exit(5);
}

#define CLIENT(name, type) \
  client(name, &rcl_interfaces_srv_dds__##type##_Request__desc, &rcl_interfaces_srv_dds__##type##_Response__desc)

int main(int argc, char **argv) {
  if (argc != 2) return 2;
  node = dds_create_participant((dds_domainid_t)atol(argv[1]), NULL, NULL);
  if (node < 0) return 3;
  Client list = CLIENT("list_parameters", ListParameters), get = CLIENT("get_parameters", GetParameters),
         set = CLIENT("set_parameters", SetParameters);
  rcl_interfaces_srv_dds__ListParameters_Request_ all = {.client = us, .number = ++number};
  dds_write(list.writer, &all);
  rcl_interfaces_srv_dds__ListParameters_Response_ *names = response(list);
  for (uint32_t k = 0; k < names->result.names._length; k++) printf("name %s\n", names->result.names._buffer[k]);
  for (double value = 0.75; value < 10.0; value *= 10.0) {
    rcl_interfaces_msg_dds__Parameter_ gain = {.name = "gain", .value = {.type = 3, .double_value = value}};
    gain.value.string_value = "";
    rcl_interfaces_srv_dds__SetParameters_Request_ request = {.client = us, .number = ++number};
    request.parameters._buffer = &gain;
    request.parameters._length = request.parameters._maximum = 1;
    dds_write(set.writer, &request);
    rcl_interfaces_srv_dds__SetParameters_Response_ *done = response(set);
    printf("set %d %s\n", done->results._buffer[0].successful, done->results._buffer[0].reason);
  }
  char *wanted[1] = {"gain"};
  rcl_interfaces_srv_dds__GetParameters_Request_ request = {.client = us, .number = ++number};
  request.names._buffer = wanted;
  request.names._length = request.names._maximum = 1;
  dds_write(get.writer, &request);
  rcl_interfaces_srv_dds__GetParameters_Response_ *found = response(get);
  printf("get %d %.17g\n", found->values._buffer[0].type, found->values._buffer[0].double_value);
  dds_delete(node);
  return 0;
}
