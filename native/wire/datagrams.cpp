// Datagrams to and from a socket that has another owner. Documented in armlab/kernels/_native.pyi.
//
// Python's own calls raise an exception if no datagram is waiting, parse the address each time and
// release the GIL at each call, which takes three times as long as the system calls.
#include "array/arrays.h"

#include <nanobind/stl/vector.h>

#include <arpa/inet.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <time.h>

#include <cerrno>

namespace armlab::python {
namespace {

constexpr std::size_t largest = 65535;
constexpr std::int64_t stale_ns = 10'000'000'000;  // an older stamp means that the clock was set

std::int64_t clock_ns(clockid_t clock) {
  timespec now;
  clock_gettime(clock, &now);
  return now.tv_sec * 1'000'000'000LL + now.tv_nsec;
}

std::int64_t now_ns() { return clock_ns(CLOCK_MONOTONIC); }

class Datagrams {
 public:
  Datagrams(nb::handle socket, nb::handle kind)
      : socket_(nb::borrow(socket)),
        kind_(nb::borrow(kind)),
        fd_(nb::cast<int>(socket.attr("fileno")())) {
    if (!PyType_Check(kind.ptr()) || !PyType_IsSubtype(type(), &PyTuple_Type))
      throw nb::type_error(
          "Expected a named tuple with fields data, source and ns for the datagrams.");
  }

  nb::object receive() {
    char control[256];
    sockaddr_in from{};
    iovec part{buffer_, largest};
    msghdr message{};
    message.msg_name = &from, message.msg_namelen = sizeof from;
    message.msg_iov = &part, message.msg_iovlen = 1;
    message.msg_control = control, message.msg_controllen = sizeof control;
    const ssize_t size = recvmsg(fd_, &message, MSG_DONTWAIT);
    if (size < 0) {
      errors_ += errno != EAGAIN && errno != EWOULDBLOCK;
      return nb::none();
    }
    std::int64_t ns = now_ns();
#ifdef SCM_TIMESTAMPNS  // Linux stamps each datagram on arrival
    for (cmsghdr *found = CMSG_FIRSTHDR(&message); found; found = CMSG_NXTHDR(&message, found)) {
      if (found->cmsg_level != SOL_SOCKET || found->cmsg_type != SCM_TIMESTAMPNS) continue;
      timespec stamp;
      std::memcpy(&stamp, CMSG_DATA(found), sizeof stamp);
      const std::int64_t age =
          clock_ns(CLOCK_REALTIME) - (stamp.tv_sec * 1'000'000'000LL + stamp.tv_nsec);
      if (age >= 0 && age < stale_ns) ns -= age;
    }
#endif
    if (from.sin_addr.s_addr != from_.sin_addr.s_addr || from.sin_port != from_.sin_port ||
        !source_.is_valid()) {
      char host[INET_ADDRSTRLEN] = "";
      inet_ntop(AF_INET, &from.sin_addr, host, sizeof host);
      source_ = nb::make_tuple(static_cast<const char *>(host), ntohs(from.sin_port));
      from_ = from;
    }
    const nb::object made = nb::steal(type()->tp_alloc(type(), 3));
    if (!made.is_valid()) throw nb::python_error();
    PyTuple_SET_ITEM(
        made.ptr(), 0, nb::bytes(buffer_, static_cast<std::size_t>(size)).release().ptr());
    PyTuple_SET_ITEM(made.ptr(), 1, nb::object(source_).release().ptr());
    PyTuple_SET_ITEM(made.ptr(), 2, nb::int_(ns).release().ptr());
    return made;
  }

  bool send(nb::bytes data, nb::tuple to) {
    if (to.size() != 2) throw nb::type_error("Expected the address and port of the receiver.");
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_port = htons(nb::cast<std::uint16_t>(to[1]));
    const bool sent = inet_pton(AF_INET, nb::cast<const char *>(to[0]), &address.sin_addr) == 1 &&
                      sendto(fd_, data.c_str(), data.size(), MSG_DONTWAIT,
                          reinterpret_cast<sockaddr *>(&address), sizeof address) >= 0;
    errors_ += !sent;
    return sent;
  }

  // The descriptor must be dropped, because the system may reuse it once the socket is closed.
  void close() {
    fd_ = -1;
    socket_.attr("close")();
  }

  std::int64_t errors() const { return errors_; }

 private:
  PyTypeObject *type() const { return reinterpret_cast<PyTypeObject *>(kind_.ptr()); }

  nb::object socket_, kind_;
  int fd_;
  std::int64_t errors_ = 0;
  sockaddr_in from_{};
  nb::object source_;
  char buffer_[largest];
};

// Releases the GIL once, so other threads run meanwhile and do not contend for it afterwards.
bool await_datagram(const std::vector<int> &sockets, std::int64_t poll_ns, std::int64_t end_ns) {
  std::vector<pollfd> all;
  for (const int number : sockets) all.push_back({number, POLLIN, 0});
  nb::gil_scoped_release released;
  const std::int64_t left = std::max<std::int64_t>(std::min(poll_ns, end_ns) - now_ns(), 0);
  const timespec sleep{left / 1'000'000'000, left % 1'000'000'000}, none{};
  int found = ppoll(all.data(), all.size(), &sleep, nullptr);
  while (found == 0 && now_ns() < end_ns) found = ppoll(all.data(), all.size(), &none, nullptr);
  return found > 0;  // false after a signal, which Python handles first
}

}  // namespace
}  // namespace armlab::python

void armlab::python::bind_datagrams(nb::module_ &m) {
  nb::class_<Datagrams>(m, "Datagrams", "See _native.pyi.")
      .def(nb::init<nb::handle, nb::handle>(), arg("socket"), arg("kind"))
      .def("receive", &Datagrams::receive)
      .def("send", &Datagrams::send, arg("data"), arg("to"))
      .def("close", &Datagrams::close)
      .def_prop_ro("errors", &Datagrams::errors);
  m.def("await_datagram", &await_datagram, arg("sockets"), arg("poll_ns"), arg("end_ns"),
      "See _native.pyi.");
}
