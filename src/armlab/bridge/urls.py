"""Parsing of link URLs: `addresses` returns one `Address` per robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple
from urllib.parse import SplitResult, parse_qsl, unquote, urlencode, urlsplit

from armlab.errors import ConfigError

_PORT = 6510  # for a single arm
_PORTS = 6511  # first of several arms: 6511 left, 6512 right
_ZENOH = 7447  # port of the router
_RWS = ("rws", "ca", "insecure")  # options: Robot Web Services host and certificate verification
_LABCOMM = 7511  # first port of a LabComm server: 7511 left, 7512 right


class Address(NamedTuple):
    """Address of one robot."""

    scheme: str
    host: str
    port: int
    robot: str
    options: dict[str, str]


def addresses(urls: Sequence[str], count: int) -> list[Address]:
    ports = [_PORTS + index if count > 1 else _PORT for index in range(len(urls))]
    rows = [_LABCOMM + index for index in range(len(urls))]
    found = [one for url, *numbers in zip(urls, ports, rows, strict=True) for one in _taken_apart(url, *numbers)]
    if len(found) != count:
        raise ConfigError(f"Expected one URL per robot, got {len(found)} for {count}: {', '.join(urls)}.")
    if len({(address.scheme, *sorted(_shared(address).items())) for address in found}) > 1:
        raise ConfigError(
            f"Expected all URLs of a link to have the same scheme and options, got {', '.join(urls)}. "
            "Only the seeds of simulated robots may differ."
        )
    bound = [(one.host, one.port) for one in found if one.port and one.scheme != "zenoh"]
    if len(set(bound)) < len(bound):
        raise ConfigError(f"Expected a separate port for each arm, got {', '.join(urls)}.")
    return found


def choosing_arm(url: str, chosen: Mapping[str, str]) -> str:
    """Return the URL; for a simulated robot, add any missing options `base`, `tip` and `lock`."""
    missing = urlencode({name: value for name, value in chosen.items() if f"{name}=" not in url})
    return f"{url}{'&' if '?' in url else '?'}{missing}" if missing and url.startswith("sim:") else url


def simulator_options(found: Sequence[Address]) -> dict[str, str]:
    """Return the simulator options for all robots, with one seed per robot if the seeds differ."""
    seeds = [one.options.get("seed", "0") for one in found]
    return found[0].options if len(set(seeds)) == 1 else {**found[0].options, "seed": ",".join(seeds)}


def _shared(address: Address) -> dict[str, str]:
    return {name: value for name, value in address.options.items() if (address.scheme, name) != ("sim", "seed")}


def split_url(url: str) -> SplitResult:
    try:
        parts = urlsplit(url if isinstance(url, str) else "")
        if parts.password is not None or "@" in dict(parse_qsl(parts.query)).get("rws", ""):  # not echoed
            raise ConfigError(
                "Expected a URL without a password, but the URL contains "
                "a password. Store passwords in environment variables."
            )
        return parts
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"Expected a URL such as egm://127.0.0.1:6510, got {url!r} ({error}).") from None


def _taken_apart(url: str, port: int, rows: int) -> list[Address]:
    parts = split_url(url)
    simulated = parts.netloc + parts.path if parts.scheme == "sim" else ""
    if parts.scheme not in ("egm", "sim", "labcomm", "zenoh") or not (parts.netloc or simulated):
        raise ConfigError(f"Expected a link such as egm://127.0.0.1:6510 or sim://yumi_right, got {url!r}.")
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    if parts.scheme == "sim":
        return [Address("sim", "127.0.0.1", 0, robot, options) for robot in map(unquote, simulated.split("+"))]
    if parts.scheme == "labcomm":
        port = rows
    elif parts.scheme == "zenoh":
        port, options = _ZENOH, {"lab": parts.path.strip("/"), **options}
    elif unknown := [name for name in options if name not in _RWS or "rws" not in options]:
        raise ConfigError(
            f"Expected only the options rws=HOST, optionally with ca=FILE or insecure=true, in an egm link, got "
            f"{', '.join(unknown)} in {url!r}."
        )
    number = parts.netloc.rpartition(":")[2] if ":" in parts.netloc else str(port)
    number = number.lstrip("0") or number[:1]  # int() raises an error for 5000 digits
    if not parts.hostname or not number.isascii() or not number.isdigit() or int(number[:6]) > 65535:
        raise ConfigError(f"Expected {parts.scheme}://HOST:PORT with a port from 0 to 65535, got {url!r}.")
    return [Address(parts.scheme, parts.hostname, int(number), "", options)]
