// A compiled EGM client for `egm_round_trips`: `egm_peer PORT REPLY`. If LIBEGM is defined, the
// client uses abb_libegm's controller interface and sends back the received joint positions.
// Otherwise, it is a minimal client that answers each packet with REPLY, a datagram in hexadecimal
// digits. Exits after 5 s without a packet.
#include <arpa/inet.h>
#include <sched.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <string>

constexpr int priority = 50, patience = 60, silence = 5;  // s

#ifdef LIBEGM
#include <abb_libegm/egm_controller_interface.h>

#include <thread>

void answer(int port, const std::string &) {
  boost::asio::io_service service;
  abb::egm::EGMControllerInterface egm(service, static_cast<unsigned short>(port));
  if (!egm.isInitialized()) std::exit(1);
  std::thread([&service] { service.run(); }).detach();
  std::puts("ready"), std::fflush(stdout);
  abb::egm::wrapper::Input input;
  abb::egm::wrapper::Output output;
  for (int wait = patience; egm.waitForMessage(1000 * wait); wait = silence) {
    egm.read(&input);
    auto *robot = output.mutable_robot()->mutable_joints()->mutable_position();
    robot->CopyFrom(input.feedback().robot().joints().position());
    output.mutable_external()->mutable_joints()->mutable_position()->CopyFrom(
        input.feedback().external().joints().position());
    egm.write(output);
  }
  _exit(0);  // the service waits for more
}
#else
void answer(int port, const std::string &reply) {
  const int number = socket(AF_INET, SOCK_DGRAM, 0);
  sockaddr_in address{}, from{};
  address.sin_family = AF_INET, address.sin_port = htons(static_cast<std::uint16_t>(port));
  if (bind(number, reinterpret_cast<sockaddr *>(&address), sizeof address)) std::exit(1);
  std::puts("ready"), std::fflush(stdout);
  char buffer[65536];
  for (timeval wait{patience, 0};; wait.tv_sec = silence) {
    setsockopt(number, SOL_SOCKET, SO_RCVTIMEO, &wait, sizeof wait);
    socklen_t size = sizeof from;
    auto *sender = reinterpret_cast<sockaddr *>(&from);
    if (recvfrom(number, buffer, sizeof buffer, 0, sender, &size) < 0) return;
    sendto(number, reply.data(), reply.size(), 0, sender, size);
  }
}
#endif

int main(int, char **words) {
  const sched_param wanted{priority};
  if (sched_setscheduler(0, SCHED_FIFO, &wanted)) std::fputs("normal priority\n", stderr);
  std::string reply;
  for (const char *digit = words[2]; digit[0] && digit[1]; digit += 2)
    reply.push_back(static_cast<char>(std::stoi(std::string(digit, 2), nullptr, 16)));
  answer(std::atoi(words[1]), reply);
}
