"""Zenoh sessions as armlab has them everywhere: no multicast, quick to connect again, and always closed."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from typing import Any, Literal

from armlab.bridge.zenoh.security import Security
from armlab.errors import LinkError, MissingExtra

__all__ = ["close_session", "data_of", "open_near", "open_session", "queried", "wait_for_router", "zenoh"]

_RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
_OPENED = 1500  # ms for the other end to answer a connection
_ROOM = 16  # messages that wait for a connection, the most there is: two would not last while a process is not run
_BEFORE_DROP = 20_000  # us for room, once when a reader falls behind: it may only not have been run
_BEFORE_CLOSE = 250_000  # us, after seconds in buffers: a put that waits holds up whoever declares, and they all others
_TRIES = 2  # to be router or else to find one: it may end just then
_FOUND = 1.0  # s in which a router on this computer is found

_open: set[Any] = set()
_lock = threading.Lock()
_watcher: list[threading.Thread] = []


def zenoh() -> Any:
    """Return the module.

    Raises
    ------
    MissingExtra : it is not installed; says how to.
    """
    try:
        import zenoh as module
    except ImportError:
        raise MissingExtra(
            "Expected eclipse-zenoh to speak Zenoh, got none. Install it: pip install 'armlab[net]'."
        ) from None
    return module


def open_session(
    mode: Literal["router", "peer", "client"],
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    security: Security | None = None,
) -> Any:
    """Return a session; `close_session` ends it. One that is forgotten is closed when the program ends.

    Parameters
    ----------
    mode : "router" is found by others at its address; "peer" finds them through a router; "client" stays behind it.
    listen, connect : "HOST:PORT"; port 0 lets the system choose. Connections that fail are tried again for ever.
    security : certificates and passwords; None for neither.

    Raises
    ------
    LinkError : an address cannot be bound, or a file of `security` cannot be used. MissingExtra : see `zenoh`.
    """
    module, safe = zenoh(), security or Security()
    protocol = "tls" if safe.ca is not None else "tcp"
    values: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": [f"{protocol}/{place}" for place in listen],
        "connect/endpoints": [f"{protocol}/{place}" for place in connect],
        "connect/exit_on_failure": False,
        "connect/retry": _RETRY,
        "scouting/multicast/enabled": False,
        "transport/unicast/open_timeout": _OPENED,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": _BEFORE_DROP,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": _BEFORE_CLOSE,
        **{f"transport/link/tx/queue/size/{priority}": _ROOM for priority in ("data", "data_low")},
        "transport/shared_memory/enabled": False,
        **safe.values(listens=bool(listen)),
    }
    config = module.Config()
    for name, value in values.items():
        config.insert_json5(name, json.dumps(value))
    try:
        session = module.open(config)
    except module.ZError as error:
        raise LinkError(f"Expected a Zenoh session, but {_short(error)}. Choose another address or port.") from None
    with _lock:
        _open.add(session)
        if not _watcher:
            _watcher.append(threading.Thread(target=_close_at_exit, name="zenoh at exit"))
            _watcher[0].start()
    return session


def open_near(host: str, port: int, router: str = "", security: Security | None = None) -> tuple[Any, str]:
    """Return the session of a server, and where it is in words: a router of its own, unless there is one.

    Parameters
    ----------
    host, port : where others find it. When the port is taken, by the router of another server, that one is used.
    router : "HOST:PORT" of a router elsewhere. security : see `open_session`.

    Raises
    ------
    LinkError : the port is taken by something else than a router.
    """
    protocol = "tls" if security is not None and security.ca is not None else "tcp"
    place = router or f"{host}:{port}"
    for _ in range(_TRIES):
        if not router:
            try:
                return open_session("router", [place], security=security), f"{protocol}/{place} (zenoh router)"
            except LinkError as error:
                if "in use" not in str(error):
                    raise
        session = open_session("peer", [f"{host}:0"], [place], security)
        if router or wait_for_router(session, _FOUND):
            return session, f"{protocol}/{host}:0 (zenoh, through the router at {place})"
        close_session(session)
    raise LinkError(
        f"Expected a Zenoh router at {place} or a free port, but something else holds it, or it asks for other "
        "certificates and passwords. Choose another `port`."
    )


def wait_for_router(session: Any, patience: float) -> bool:
    """Return whether a peer has found a router, or another peer.

    Parameters
    ----------
    session : of the peer. patience : s to wait.
    """
    until = time.monotonic() + patience
    while not (session.info.routers_zid() or session.info.peers_zid()):
        if time.monotonic() > until:
            return False
        time.sleep(0.01)
    return True


def close_session(session: Any) -> None:
    """Close a session; again is no mistake.

    Parameters
    ----------
    session : of `open_session`.
    """
    with _lock:
        known = session in _open
        _open.discard(session)
    if known:
        session.close()


def data_of(part: Any) -> bytes | None:
    """Return the bytes of a payload or an attachment, None when there is none.

    Parameters
    ----------
    part : of a sample or a query.
    """
    return None if part is None else part.to_bytes()


def queried(session: Any, selector: str, patience: float) -> list[tuple[str, bytes]]:
    """Return what was answered to a query: keys and bytes.

    Parameters
    ----------
    session : open. selector : key. patience : s to wait at most.
    """
    found = []
    for reply in session.get(selector, timeout=patience):
        if reply.ok is not None:
            found.append((str(reply.ok.key_expr), reply.ok.payload.to_bytes()))
    return found


def _close_at_exit() -> None:
    """Close what is open when the main thread has ended: Python waits for the threads of callbacks before `atexit`."""
    threading.main_thread().join()
    for session in list(_open):
        close_session(session)


def _short(error: Exception) -> str:
    """Return what a ZError says without the places in its sources."""
    return str(error).partition(" at /")[0].rstrip(".")
